"""Stores on S3: every command accepts the address, and errors name the server's problem."""

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
    """Return an address for the store of this test."""
    return address(request)


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Return a function that runs a command with `--json`: exit code, document, stderr."""

    def command(*args: object) -> tuple[int, Any, str]:
        code = main([*map(str, args), "--json"])
        out, err = capsys.readouterr()
        return code, json.loads(out) if out else None, err

    return command


@pytest.mark.long
def test_every_store_command_accepts_s3_address(place, tmp_path, run):
    bag = ROOT / "sample_logs" / "amr_tuesday"
    code, document, _ = run("ingest", bag, "--store", place)
    assert (code, document["recordings"][0]["status"]) == (0, "written")
    count = document["recordings"][0]["transitions"]
    code, document, _ = run("ingest", bag, "--store", place)
    assert (code, document["recordings"][0]["status"]) == (0, "unchanged")
    code, document, _ = run("sql", place, "SELECT sum(primary_rows)::INT AS rows FROM coverage")
    assert (code, document) == (0, [{"rows": count}])
    code, document, _ = run("audit", place)
    assert code in (0, 1)
    assert document["store"].replace("s3:/", "").strip("/") == place.replace("s3:/", "").strip("/")
    code, document, _ = run("store", "label", place, "--dry-run")
    assert (code, document["recordings"][0]["changed"]) == (0, 0)
    code, document, err = run("mix", place, "--mixture", "uniform", "--out", tmp_path / "panel")
    assert (code, err) == (0, "")
    assert document["store_version"] == 1
    header = json.loads((tmp_path / "panel" / "panel.json").read_text())
    assert place in json.dumps(header, ensure_ascii=False)
    code, document, err = run("coverage", "diff", f"{place}@0", place)
    assert (code, err) == (0, "")
    assert (document["a"]["rows"], document["b"]["rows"]) == (0, count)
    code, document, err = run("coverage", "gaps", place)
    assert (code, err, document["store_version"]) == (0, "", 1)


def test_camera_frames_on_s3(place, tmp_path):
    bag = camera_bag(tmp_path / "bag")
    for _ in range(2):
        ingest(bag, profile_with(), store=StoreWriter(place), force=True)
    assert StoreWriter(place).clean() == []  # replaced files are kept during the retention window
    with Store(place) as store:
        frames = list(camera_frames(store, "FROM transitions WHERE step_index = 3", "rear"))
    assert [frame.frame_index for frame in frames] == [6]
    assert (frames[0].image() == picture(6)).all()


def test_second_writer_of_a_version_is_rejected(place, monkeypatch):
    """Without conditional puts the second writer would overwrite the first one's commit."""
    StoreWriter(place).write(*one(1))
    late = Location.of(place).open_table(TRANSITIONS)
    put = boto3.client("s3").put_object
    key = f"{place.removeprefix(f's3://{BUCKET}/')}/transitions/_delta_log/{2:020}.json"
    StoreWriter(place).write(*one(2))
    assert late.version() == 1
    with pytest.raises(boto3.client("s3").exceptions.ClientError, match="PreconditionFailed"):
        put(Bucket=BUCKET, Key=key, Body=b"", IfNoneMatch="*")
    StoreWriter(place).transact(late, [], [])  # finds version 2 taken, and commits version 3
    assert Location.of(place).open_table(TRANSITIONS).version() == 3
    assert len(shown(place)) == 2


@pytest.fixture
def short_timeouts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorten the S3 timeouts to a second or two."""
    for name, value in (("CONNECT_S", 1), ("REQUEST_S", 1), ("RETRIES", 1), ("RETRY_S", 1)):
        monkeypatch.setattr(location, name, value)


def reader_and_writer_errors(place: str) -> list[str]:
    """Return the errors that a reader and a writer get."""
    errors = []
    for work in (lambda: Store(place), lambda: StoreWriter(place).write(*one(1))):
        with pytest.raises(StoreError) as caught:
            work()
        errors.append(str(caught.value))
    return errors


@pytest.mark.parametrize(
    ("place", "server", "message"),
    [
        ("s3://no-such-bucket/store", None, "this bucket does not exist\n"),
        ("s3://warehouse/store", "http://127.0.0.1:1", "the server cannot be reached\n  check AWS"),
        ("s3://warehouse/store", "silent", "the server does not answer\n"),
        ("s3://warehouse/store", "127.0.0.1:9000", "AWS_ENDPOINT_URL is '127.0.0.1:9000'"),
    ],
)
def test_s3_server_problem_is_reported(
    s3_server, monkeypatch, short_timeouts, place, server, message
):
    with socket.create_server(("127.0.0.1", 0)) as silent:
        if server is not None:
            address = f"http://127.0.0.1:{silent.getsockname()[1]}"
            monkeypatch.setenv("AWS_ENDPOINT_URL", address if server == "silent" else server)
        for error in reader_and_writer_errors(place):
            assert message in error
