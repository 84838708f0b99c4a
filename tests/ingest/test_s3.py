"""A store on S3: all verbs take its address, and errors say what is wrong with the server."""

import json
import socket
from collections.abc import Callable
from typing import Any

import pytest
from support.cameras import camera_bag, picture, profile_with
from support.paths import ROOT
from support.s3_server import BUCKET, address
from support.stores import one, shown

from restock.cli import main
from restock.errors import StoreError
from restock.ingest.pipeline import ingest
from restock.ingest.store import location
from restock.ingest.store.location import TRANSITIONS, Location
from restock.ingest.store.writer import StoreWriter
from restock.replay.store.frames import camera_frames
from restock.replay.store.store import Store

boto3 = pytest.importorskip("boto3")
pytest.importorskip("moto")

Run = Callable[..., tuple[int, Any, str]]


@pytest.fixture
def place(s3_server: str, request: pytest.FixtureRequest) -> str:
    """Return a place for a store, of this test alone."""
    return address(request)


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run a command line with `--json`: exit code, the document, stderr."""

    def command(*args: object) -> tuple[int, Any, str]:
        code = main([*map(str, args), "--json"])
        out, err = capsys.readouterr()
        return code, json.loads(out) if out else None, err

    return command


@pytest.mark.long
def test_every_verb_of_a_store_takes_the_address(place, tmp_path, run):
    bag = ROOT / "sample_logs" / "amr_tuesday"
    code, said, _ = run("ingest", bag, "--store", place)
    assert (code, said["recordings"][0]["status"]) == (0, "written")
    count = said["recordings"][0]["transitions"]
    code, said, _ = run("ingest", bag, "--store", place)
    assert (code, said["recordings"][0]["status"]) == (0, "unchanged")
    code, said, _ = run("sql", place, "SELECT sum(primary_rows)::INT AS rows FROM coverage")
    assert (code, said) == (0, [{"rows": count}])
    code, said, _ = run("audit", place)
    assert code in (0, 1)
    assert said["store"].replace("s3:/", "").strip("/") == place.replace("s3:/", "").strip("/")
    code, said, _ = run("store", "label", place, "--dry-run")
    assert (code, said["recordings"][0]["changed"]) == (0, 0)
    code, said, err = run("mix", place, "--mixture", "uniform", "--out", tmp_path / "panel")
    assert (code, err) == (0, "")
    assert said["store_version"] == 1
    header = json.loads((tmp_path / "panel" / "panel.json").read_text())
    assert place in json.dumps(header, ensure_ascii=False)
    code, said, err = run("coverage", "diff", f"{place}@0", place)
    assert (code, err) == (0, "")
    assert (said["a"]["rows"], said["b"]["rows"]) == (0, count)
    code, said, err = run("coverage", "gaps", place)
    assert (code, err, said["store_version"]) == (0, "", 1)


def test_frames_of_cameras_lie_there_too(place, tmp_path):
    bag = camera_bag(tmp_path / "bag")
    for _ in range(2):
        ingest(bag, profile_with(), store=StoreWriter(place), force=True)
    assert StoreWriter(place).clean() == []  # what was replaced is kept for its window
    with Store(place) as store:
        frames = list(camera_frames(store, "FROM transitions WHERE step_index = 3", "rear"))
    assert [frame.frame_index for frame in frames] == [6]
    assert (frames[0].image() == picture(6)).all()


def test_of_two_writers_of_one_version_the_second_is_refused(place, monkeypatch):
    """Conditional puts: without them the second would write over the first one's commit."""
    StoreWriter(place).write(*one(1))
    late = Location.of(place).open_table(TRANSITIONS)
    put = boto3.client("s3").put_object
    key = f"{place.removeprefix(f's3://{BUCKET}/')}/transitions/_delta_log/{2:020}.json"
    StoreWriter(place).write(*one(2))
    assert late.version() == 1
    with pytest.raises(boto3.client("s3").exceptions.ClientError, match="PreconditionFailed"):
        put(Bucket=BUCKET, Key=key, Body=b"", IfNoneMatch="*")
    StoreWriter(place).transact(late, [], [])  # finds version 2 taken, and becomes 3
    assert Location.of(place).open_table(TRANSITIONS).version() == 3
    assert len(shown(place)) == 2


@pytest.fixture
def hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    """Patience of a second or two."""
    for name, value in (("CONNECT_S", 1), ("REQUEST_S", 1), ("RETRIES", 1), ("RETRY_S", 1)):
        monkeypatch.setattr(location, name, value)


def both(place: str) -> list[str]:
    """Return what a reader and a writer are told."""
    errors = []
    for work in (lambda: Store(place), lambda: StoreWriter(place).write(*one(1))):
        with pytest.raises(StoreError) as caught:
            work()
        errors.append(str(caught.value))
    return errors


@pytest.mark.parametrize(
    ("place", "server", "said"),
    [
        ("s3://no-such-bucket/store", None, "this bucket does not exist\n"),
        ("s3://warehouse/store", "http://127.0.0.1:1", "the server cannot be reached\n  check AWS"),
        ("s3://warehouse/store", "silent", "the server does not answer\n"),
        ("s3://warehouse/store", "127.0.0.1:9000", "AWS_ENDPOINT_URL is '127.0.0.1:9000'"),
    ],
)
def test_what_is_wrong_with_a_server_is_named(s3_server, monkeypatch, hurried, place, server, said):
    with socket.create_server(("127.0.0.1", 0)) as silent:
        if server is not None:
            address = f"http://127.0.0.1:{silent.getsockname()[1]}"
            monkeypatch.setenv("AWS_ENDPOINT_URL", address if server == "silent" else server)
        for error in both(place):
            assert said in error
