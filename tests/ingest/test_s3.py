"""A store on S3: all verbs take its address, and errors say what is wrong with the server.

What it shares with a store in a folder is in `test_store`.
"""

from __future__ import annotations

import json
import socket
import subprocess
import sys
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
from restock.replay.store.store import Store, is_store

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


def test_a_bucket_that_is_not_there_is_named(s3_server):
    for said in both("s3://no-such-bucket/store"):
        assert said.startswith("s3://no-such-bucket/store: this bucket does not exist\n")


def test_a_server_that_is_not_there_is_said_so(s3_server, monkeypatch, hurried):
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:1")
    for said in both("s3://warehouse/store"):
        assert "the server cannot be reached\n  check AWS_ENDPOINT_URL" in said


def test_a_server_that_does_not_answer_is_given_up(s3_server, monkeypatch, hurried):
    with socket.create_server(("127.0.0.1", 0)) as silent:
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{silent.getsockname()[1]}")
        for said in both("s3://warehouse/store"):
            assert "the server does not answer\n" in said


def test_an_address_that_is_none_is_refused(s3_server, monkeypatch):
    monkeypatch.setenv("AWS_ENDPOINT_URL", "127.0.0.1:9000")
    for said in both("s3://warehouse/store"):
        assert "AWS_ENDPOINT_URL is '127.0.0.1:9000'" in said
        assert "http://127.0.0.1:9000" in said


@pytest.mark.parametrize(
    ("answer", "meaning"),
    [
        ("<Error><Code>InvalidAccessKeyId</Code></Error>", "does not know the access key"),
        ("<Error><Code>SignatureDoesNotMatch</Code></Error>", "refused the signature"),
        ("<Error><Code>AccessDenied</Code></Error>", "access is denied"),
        ("<Error><Code>ExpiredToken</Code></Error>", "credentials have expired"),
    ],
)
def test_credentials_that_are_refused(s3_server, monkeypatch, hurried, answer, meaning):
    """moto takes any credentials, so a server that takes none stands in for it."""
    code = (
        "import http.server, sys\n"
        "class Refuses(http.server.BaseHTTPRequestHandler):\n"
        "    def do_GET(self):\n"
        "        self.send_response(403)\n"
        f"        self.send_header('Content-Length', '{len(answer)}')\n"
        "        self.end_headers()\n"
        f"        self.wfile.write(b'{answer}')\n"
        "    do_PUT = do_POST = do_GET\n"
        "    def log_message(self, *args): pass\n"
        "server = http.server.ThreadingHTTPServer(('127.0.0.1', 0), Refuses)\n"
        "print(server.server_port, flush=True)\n"
        "server.serve_forever()\n"
    )
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as refusing:
        assert refusing.stdout is not None
        port = int(refusing.stdout.readline())
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{port}")
        try:
            for said in both("s3://warehouse/store"):
                assert meaning in said
        finally:
            refusing.kill()


def test_no_store_where_there_is_none(s3_server, run):
    assert not is_store(f"s3://{BUCKET}/nothing")
    code, _, err = run("sql", f"s3://{BUCKET}/nothing", "FROM coverage")
    assert code == 2
    assert f"s3://{BUCKET}/nothing: no such store" in err
    code, _, err = run("sql", "gs://bucket/store", "FROM coverage")
    assert code == 2
    assert "cannot be on gs:" in err
