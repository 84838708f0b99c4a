"""A store on S3: ingested, queried, replaced and cleaned as in a folder, whoever else writes."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from support.paths import ROOT
from support.s3_server import s3_server
from support.stores import one, shown

import restock
from restock.cli import main
from restock.errors import StoreError
from restock.ingest.store import location
from restock.ingest.store.location import Location
from restock.ingest.store.writer import RECORDINGS, TRANSITIONS, StoreWriter
from restock.replay.store.store import Store, is_store

boto3 = pytest.importorskip("boto3")
pytest.importorskip("moto")

BUCKET = "warehouse"
Run = Callable[..., tuple[int, Any, str]]


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    with s3_server() as address, pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ENDPOINT_URL", address)
        patch.setenv("AWS_ACCESS_KEY_ID", "key")
        patch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
        patch.setenv("AWS_REGION", "us-east-1")
        boto3.client("s3").create_bucket(Bucket=BUCKET)
        yield address


@pytest.fixture
def place(server: str, request: pytest.FixtureRequest) -> str:
    """A place for a store, of this test alone."""
    return f"s3://{BUCKET}/site 7/{request.node.name}"


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run a command line with `--json`: exit code, the document, stderr."""

    def command(*args: object) -> tuple[int, Any, str]:
        code = main([*map(str, args), "--json"])
        out, err = capsys.readouterr()
        return code, json.loads(out) if out else None, err

    return command


def objects(prefix: str) -> list[str]:
    found = boto3.client("s3").list_objects_v2(Bucket=BUCKET, Prefix=prefix)
    return [entry["Key"] for entry in found.get("Contents", [])]


def test_every_verb_of_a_store_takes_the_address(place, tmp_path, run):
    bag = ROOT / "sample_logs" / "amr_tuesday"
    code, said, _ = run("ingest", bag, "--store", place)
    assert (code, said["recordings"][0]["status"]) == (0, "written")
    count = said["recordings"][0]["transitions"]
    code, said, _ = run("ingest", bag, "--store", place)
    assert (code, said["recordings"][0]["status"]) == (0, "unchanged")
    code, said, _ = run("sql", place, "SELECT sum(rows)::INT AS rows FROM coverage")
    assert (code, said) == (0, [{"rows": count}])
    code, said, _ = run("audit", place)
    assert code in (0, 1)
    assert said["store"].replace("s3:/", "").strip("/") == place.replace("s3:/", "").strip("/")
    code, said, _ = run("label", place, "--dry-run")
    assert (code, said["recordings"][0]["changed"]) == (0, 0)
    code, said, err = run("mix", place, "--mixture", "uniform", "--out", tmp_path / "panel")
    assert (code, err) == (0, "")
    assert said["store_version"] == 1
    header = json.loads((tmp_path / "panel" / "panel.json").read_text())
    assert place in json.dumps(header, ensure_ascii=False)


def test_what_is_written_is_read_with_every_type(place):
    manifest, rows = one(1)
    StoreWriter(place).write(manifest, rows)
    with restock.open(place) as store:
        found = store.sql("FROM transitions ORDER BY transition_id").to_arrow_table()
        assert str(store.path) == place
    for name in rows.column_names:
        assert found[name].to_pylist() == rows[name].to_pylist(), name
    assert found.schema.field("observation").type.list_size == len(rows["observation"][0])
    (key,) = [name for name in objects("site 7/test_what_is_written") if "transitions/0" in name]
    assert key.endswith("/transitions/0000000000000001/0000000000000001-a.parquet")


def test_a_query_reads_only_the_columns_and_rows_it_asks_for(place):
    StoreWriter(place).write(*one(1))
    with Store(place) as store:
        plan = store.sql(
            "EXPLAIN SELECT avg(reward) FROM stored_transitions WHERE action = 2"
        ).fetchall()[0][1]
    assert "observation" not in plan
    assert "Filters" in plan
    assert "action" in plan.split("Filters")[1]


def test_a_recording_is_replaced_and_its_old_files_are_cleaned_away(place):
    writer = StoreWriter(place)
    version = writer.write(*one(1, "a"))
    writer.write(*one(2, "a"))
    writer.write(*one(1, "b"))
    assert sorted(shown(place)) == ["0000000000000001-b", "0000000000000002-a"]
    with Store(place, version=version) as store:  # until it is cleaned
        assert store.sql("SELECT DISTINCT ingest_id FROM transitions").fetchall() == [
            ("0000000000000001-a",)
        ]
    assert writer.clean() == []
    old = "0000000000000001/0000000000000001-a.parquet"
    assert writer.clean(retention_hours=0) == [f"{RECORDINGS}/{old}", f"{TRANSITIONS}/{old}"]
    assert not [key for key in objects("site 7/test_a_recording_is_r") if key.endswith(old)]
    assert len(shown(place)) == 2


def _write(place: str, recording: int, ingest: str) -> None:
    StoreWriter(place).write(*one(recording, ingest))


def test_writers_at_the_same_time_lose_nothing_and_double_nothing(place):
    """Processes that all make the store, two of them with the same recording."""
    context = multiprocessing.get_context("spawn")
    jobs = [(1, "a"), (1, "b"), (2, "a"), (3, "a")]
    processes = [context.Process(target=_write, args=(place, *job)) for job in jobs]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    assert [process.exitcode for process in processes] == [0] * len(jobs)
    found = shown(place)
    assert sorted(ingest.split("-")[0][-1] for ingest in found) == ["1", "2", "3"]
    for ingest, count in found.items():
        recording, name = ingest.split("-")
        assert count == len(one(int(recording, 16), name)[1])


def test_of_two_writers_of_one_version_the_second_is_refused(place, monkeypatch):
    """Conditional puts: without them the second would write over the first one's commit."""
    StoreWriter(place).write(*one(1))
    late = Location.of(place).open_table(TRANSITIONS)
    put = boto3.client("s3").put_object
    key = f"site 7/{place.rsplit('/', 1)[1]}/transitions/_delta_log/{2:020}.json"
    StoreWriter(place).write(*one(2))
    assert late.version() == 1
    with pytest.raises(boto3.client("s3").exceptions.ClientError, match="PreconditionFailed"):
        put(Bucket=BUCKET, Key=key, Body=b"", IfNoneMatch="*")
    StoreWriter(place)._transact(late, [], [])  # finds version 2 taken, and becomes 3
    assert Location.of(place).open_table(TRANSITIONS).version() == 3
    assert len(shown(place)) == 2


def _write_for_ever(place: str) -> None:
    for turn in range(1000):
        StoreWriter(place).write(*one(1, f"{turn}", seed=turn))


def test_a_killed_writer_leaves_the_last_whole_commit(place):
    StoreWriter(place).write(*one(1, "first"))
    context = multiprocessing.get_context("spawn")
    process = context.Process(target=_write_for_ever, args=(place,))
    process.start()
    while "-first" in next(iter(shown(place))):  # until it is at work
        assert process.is_alive()
        time.sleep(0.01)
    time.sleep(0.2)
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    ((ingest, count),) = shown(place).items()
    name = ingest.split("-")[1]
    assert count == len(one(1, name, seed=int(name))[1])
    StoreWriter(place).write(*one(1, "last"))
    assert list(shown(place)) == ["0000000000000001-last"]


@pytest.fixture
def hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    """Patience of a second or two."""
    for name, value in (("CONNECT_S", 1), ("REQUEST_S", 1), ("RETRIES", 1), ("RETRY_S", 1)):
        monkeypatch.setattr(location, name, value)


def both(place: str) -> list[str]:
    """What a reader and a writer are told."""
    said = []
    for work in (lambda: Store(place), lambda: StoreWriter(place).write(*one(1))):
        with pytest.raises(StoreError) as caught:
            work()
        said.append(str(caught.value))
    return said


def test_a_bucket_that_is_not_there_is_named(server):
    for said in both("s3://no-such-bucket/store"):
        assert said.startswith("s3://no-such-bucket/store: there is no such bucket\n")


def test_a_server_that_is_not_there_is_said_so(server, monkeypatch, hurried):
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:1")
    for said in both("s3://warehouse/store"):
        assert "the server cannot be reached\n  check AWS_ENDPOINT_URL" in said


def test_a_server_that_does_not_answer_is_given_up(server, monkeypatch, hurried):
    with socket.create_server(("127.0.0.1", 0)) as silent:
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{silent.getsockname()[1]}")
        for said in both("s3://warehouse/store"):
            assert "the server does not answer\n" in said


def test_an_address_that_is_none_is_refused(server, monkeypatch):
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
def test_credentials_that_are_refused(server, monkeypatch, hurried, answer, meaning):
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


def test_no_store_where_there_is_none(server, run):
    assert not is_store(f"s3://{BUCKET}/nothing")
    code, _, err = run("sql", f"s3://{BUCKET}/nothing", "FROM coverage")
    assert code == 2
    assert f"s3://{BUCKET}/nothing: no such store" in err
    code, _, err = run("sql", "gs://bucket/store", "FROM coverage")
    assert code == 2
    assert "cannot lie on gs:" in err
