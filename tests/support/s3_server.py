"""An S3 server on loopback, in a process of its own: Delta's library asks with the GIL held."""

import logging
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pytest

BUCKET = "warehouse"


def address(request: "pytest.FixtureRequest") -> str:
    """Where a store of this test alone may lie, with a space in it."""
    return f"s3://{BUCKET}/site 7/" + re.sub(r"\W+", "_", request.node.nodeid)


def files_of(place: Path | str) -> list[str]:
    """Return the files of a store by their paths in it, as the disk or the server lists them."""
    if isinstance(place, Path):
        return sorted(str(p.relative_to(place)) for p in place.rglob("*") if p.is_file())
    import boto3

    prefix = place.removeprefix(f"s3://{BUCKET}/") + "/"
    answer = boto3.client("s3").list_objects_v2(Bucket=BUCKET, Prefix=prefix)
    return sorted(entry["Key"].removeprefix(prefix) for entry in answer.get("Contents", []))


@contextmanager
def s3_server() -> Iterator[str]:
    """Yield the address of a server that is up for as long as the context."""
    command = [sys.executable, __file__]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as server:
        assert server.stdin is not None
        assert server.stdout is not None
        yield f"http://127.0.0.1:{int(server.stdout.readline())}"
        server.stdin.close()


if __name__ == "__main__":
    from moto.server import ThreadedMotoServer

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    moto = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    moto.start()
    print(moto.get_host_and_port()[1], flush=True)  # noqa: T201
    sys.stdin.read()
    moto.stop()
