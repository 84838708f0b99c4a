"""Fuzzing the readers and decoders: arbitrary bytes must end in columns or in a clear refusal.

    python fuzz/readers.py --minutes 60          # coverage-guided, with `pip install atheris`
    python fuzz/readers.py --again INPUT …       # what one input does, with its stack trace

Without atheris the seeds are mutated blindly, which finds less. An input is a finding where
anything but a `RestockError` (or a topic that says why it cannot be decoded) comes of it, where
the account of a topic does not add up, where the columnar decoder and rosbags disagree about a
message that both can read, or where it takes too long or too much memory. Each kind of finding is
kept once, in --out; the exit code is 1 where there was any.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import random
import resource
import struct
import subprocess
import sys
import tempfile
import time
import traceback
import zlib
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

try:
    import atheris
except ImportError:
    atheris = None

with (
    atheris.instrument_imports(include=["restock.ingest"]) if atheris else contextlib.nullcontext()
):
    import numpy as np
    from seeds import seeds, small_mcap
    from support.rosbags_columns import RowDecoder

    from restock.cli.data.info import describe_recording
    from restock.errors import RestockError
    from restock.ingest.containers.open_recording import open_recording
    from restock.ingest.decoding.columns import CannotDecode, Channel, MessageBatch, equal, take
    from restock.ingest.decoding.decoders import ColumnDecoder, decoder_of, type_of

MAX_INPUT = 1 << 14
SECONDS_EACH = 30
MEMORY_MB = 3000  # of one process: imports take some 500, an input may take the rest
MAX_LEAVES = 200  # of a topic that are read: a definition may have thousands

Target = Callable[[bytes], None]


class Wrong(Exception):
    """The result of an input is inconsistent."""


def require(holds: bool, what: str) -> None:
    if not holds:
        raise Wrong(what)


# -- targets ----------------------------------------------------------------------------------


def recording(data: bytes) -> None:
    """Read a file of any kind; the lowest bit of the first byte is whether to salvage."""
    with tempfile.TemporaryDirectory(dir=_memory()) as folder:
        path = Path(folder) / "input"
        path.write_bytes(data[1:])
        _read(path, salvage=bool(data[:1] > b"\x7f"))


def metadata(data: bytes) -> None:
    """Read a bag's folder with this metadata.yaml."""
    with tempfile.TemporaryDirectory(dir=_memory()) as folder:
        path = Path(folder) / "bag"
        path.mkdir()
        (path / "bag_0.mcap").write_bytes(small_mcap())
        (path / "metadata.yaml").write_bytes(data)
        _read(path, salvage=False)


def _read(path: Path, *, salvage: bool) -> None:
    try:
        describe_recording(path, salvage=salvage)
        with open_recording(path, salvage=salvage) as opened:
            wanted = {topic: opened.leaves(topic)[:MAX_LEAVES] for topic in opened.topics}
            by_topic = opened.read(wanted)
            for topic, account in opened.accounts.items():
                explained = account.decoded + sum(account.reasons.values())
                require(explained >= account.expected, f"messages went missing: {account}")
                if topic in by_topic:
                    columns = by_topic[topic]
                    require(len(columns) == account.decoded, "as many rows as were decoded")
                    require(bool((np.diff(columns.log_time_ns) >= 0).all()), "in order")
                    for path_, column in columns.fields.items():
                        require(len(column) == len(columns), f"as many rows in {path_}")
            json.dumps([opened.integrity, *(loss.reason for loss in opened.lost_messages)])
    except RestockError:
        pass


def cdr(data: bytes) -> None:
    """Decode messages by a ROS 2 definition, and compare them with rosbags."""
    definition, payloads = _parts(data)
    form = "ros2idl" if definition.startswith(b"module") else "ros2msg"
    _compare_with_rosbags("cdr", form, definition, payloads)


def ros1(data: bytes) -> None:
    """Decode messages by a ROS 1 definition, and compare them with rosbags."""
    definition, payloads = _parts(data)
    _compare_with_rosbags("ros1", "ros1msg", definition, payloads)


def _compare_with_rosbags(
    encoding: str, form: str, definition: bytes, payloads: list[bytes]
) -> None:
    channel = Channel(1, "/t", "pkg/msg/T", encoding, form, definition)
    batch = MessageBatch.of(payloads, range(len(payloads)), range(len(payloads)))
    try:
        kind = type_of(channel, "humble", lambda: payloads)
        leaves = kind.leaves()[:MAX_LEAVES]
        decoder = decoder_of(channel, kind, leaves)
        rosbags = RowDecoder(kind, leaves, ros1=encoding == "ros1")  # type: ignore[arg-type]
    except CannotDecode:
        return
    require(isinstance(decoder, ColumnDecoder), "columns")
    left, right = decoder.decode(batch), rosbags.decode(batch)
    require(len(left.rows) + sum(left.bad.values()) == len(batch), "every message is counted")
    both = np.intersect1d(left.rows, right.rows)
    for leaf in leaves:
        one = take(left.fields[leaf.path], np.searchsorted(left.rows, both))
        other = take(right.fields[leaf.path], np.searchsorted(right.rows, both))
        require(equal(one, other), f"{leaf.path} is not what rosbags reads")


def json_messages(data: bytes) -> None:
    """Decode messages by a JSON Schema."""
    schema, payloads = _parts(data)
    _decode(Channel(1, "/t", "T", "json", "jsonschema" if schema else "", schema), payloads)


def protobuf(data: bytes) -> None:
    """Decode messages by a FileDescriptorSet."""
    definition, payloads = _parts(data)
    _decode(Channel(1, "/t", "p.T", "protobuf", "protobuf", definition), payloads)


def _decode(channel: Channel, payloads: list[bytes]) -> None:
    batch = MessageBatch.of(payloads, range(len(payloads)), range(len(payloads)))
    try:
        kind = type_of(channel, "humble", lambda: payloads)
        decoder = decoder_of(channel, kind, kind.leaves()[:MAX_LEAVES])
    except CannotDecode:
        return
    decoded = decoder.decode(batch)
    require(len(decoded.rows) + sum(decoded.bad.values()) == len(batch), "every message is counted")
    for path, column in decoded.fields.items():
        require(len(column) == len(decoded.rows), f"as many rows in {path}")


def _parts(data: bytes) -> tuple[bytes, list[bytes]]:
    """Return a definition and payloads, each after its length in two bytes."""
    parts = []
    while len(data) >= 2:
        (length,) = struct.unpack_from("<H", data)
        parts.append(data[2 : 2 + length])
        data = data[2 + length :]
    return (parts[0], parts[1:]) if parts else (b"", [])


TARGETS: tuple[Target, ...] = (recording, cdr, ros1, json_messages, protobuf, metadata)


def examine(data: bytes) -> None:
    """Try one input: its first byte chooses the target.

    Raises:
        Exception: whatever is a finding.
    """
    if data:
        TARGETS[data[0] % len(TARGETS)](data[1:])


# -- running ----------------------------------------------------------------------------------


def _memory() -> str | None:
    """Where files cost no disk."""
    return "/dev/shm" if os.access("/dev/shm", os.W_OK) else None


class Findings:
    """Inputs that went wrong, each kind once."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def keep(self, data: bytes, error: BaseException) -> None:
        """Write the input and its stack trace, if it is of a kind not seen before."""
        frames = traceback.extract_tb(error.__traceback__)
        ours = [frame for frame in frames if "ingest" in Path(frame.filename).parts]
        place = (ours or frames)[-1]
        kind = f"{type(error).__name__} {Path(place.filename).name} {place.name} {place.lineno}"
        name = f"{zlib.crc32(kind.encode()):08x}"
        if (self.folder / name).exists():
            return
        (self.folder / name).write_bytes(data)
        (self.folder / f"{name}.txt").write_text("".join(traceback.format_exception(error)))
        sys.stderr.write(f"found {name}: {kind}: {str(error)[:200]!r}\n")

    def count(self) -> int:
        """How many kinds there are."""
        return sum(1 for item in self.folder.iterdir() if not item.suffix)


def fuzz(corpus: Path, out: Path, seconds: int) -> None:
    """One process' share of the work; does not return where atheris runs it."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_MB << 20, MEMORY_MB << 20))
    findings = Findings(out)

    def one(data: bytes) -> None:
        try:
            examine(data)
        except Exception as error:  # noqa: BLE001 - anything else is what is looked for
            findings.keep(data, error)

    if atheris:
        options = [f"-max_total_time={seconds}", f"-timeout={SECONDS_EACH}", "-rss_limit_mb=0"]
        options += [f"-max_len={MAX_INPUT}", f"-artifact_prefix={out}/", "-print_final_stats=1"]
        atheris.Setup([sys.argv[0], *options, str(corpus)], one, internal_libfuzzer=True)
        atheris.Fuzz()
    rng = random.Random(time.time_ns())
    known = [item.read_bytes() for item in sorted(corpus.iterdir())]
    end, count = time.monotonic() + seconds, 0
    while time.monotonic() < end:
        one(mutated(rng, known))
        count += 1
    sys.stderr.write(f"stat::number_of_executed_units: {count}\n")


def mutated(rng: random.Random, known: list[bytes]) -> bytes:
    """One of the known inputs with a few bytes changed, cut out or repeated."""
    data = bytearray(rng.choice(known))
    for _ in range(rng.randint(1, 8)):
        at = rng.randrange(1, len(data)) if len(data) > 1 else 0
        length = min(rng.choice([1, 1, 2, 4, 8, 64]), len(data) - at)
        change = rng.randrange(4)
        if change == 0:
            data[at : at + length] = rng.randbytes(length)
        elif change == 1:
            data[at : at + length] = rng.choice([b"\0", b"\xff", b"\x7f", b"\1"]) * length
        elif change == 2:
            del data[at : at + length]
        else:
            data[at:at] = data[at : at + length]
    return bytes(data)


def run(corpus: Path, out: Path, minutes: float) -> int:
    """Fuzz in a process of its own, started again where one input ends it."""
    corpus.mkdir(parents=True, exist_ok=True)
    for seed in seeds():
        (corpus / hashlib.blake2b(seed, digest_size=8).hexdigest()).write_bytes(seed)
    findings = Findings(out)
    start = time.monotonic()
    while (left := minutes * 60 - (time.monotonic() - start)) > 1:
        command = [sys.executable, __file__, "--child", str(int(left))]
        command += ["--corpus", str(corpus), "--out", str(out)]
        code = subprocess.run(command, check=False).returncode
        if code:
            sys.stderr.write(f"a process ended with {code}; its input is in {out}\n")
    took = (time.monotonic() - start) / 60
    how = "coverage-guided" if atheris else "without coverage"
    sys.stdout.write(f"{took:.1f} minutes, {how}: {findings.count()} kinds of findings in {out}\n")
    return 1 if findings.count() else 0


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--minutes", type=float, default=10, help="how long (10)")
    place = Path(tempfile.gettempdir()) / "restock-fuzz"
    parser.add_argument(
        "--corpus", type=Path, default=place / "corpus", help="grows from run to run"
    )
    parser.add_argument(
        "--out", type=Path, default=place / "findings", help="inputs that went wrong"
    )
    parser.add_argument("--again", type=Path, nargs="+", help="try these inputs, and stop at one")
    parser.add_argument("--child", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.again:
        for path in options.again:
            examine(path.read_bytes())
            sys.stdout.write(f"{path}: nothing wrong\n")
        return 0
    if options.child:
        fuzz(options.corpus, options.out, options.child)
        return 0
    return run(options.corpus, options.out, options.minutes)


if __name__ == "__main__":
    sys.exit(main())
