"""The panel: the pinned, memory-mapped set of transitions a run samples from.

A panel is a directory that never changes after it was built:

    panel.json       its source, mixture, strata, and sizes and checksums of files
    rows.f32         packed float32 rows, little-endian (layout: `replay.sampling.packed_rows`)
    meta.parquet     one row per packed row: ids, condition, behaviour policy, weight, …
    evaluation_split.parquet the transitions held out for evaluation
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
import pyarrow as pa
from blake3 import blake3
from numpy.typing import NDArray

from restock.arrays import F32, Ints
from restock.errors import PanelError
from restock.files import read_table
from restock.ingest.task.task import Task
from restock.replay.mixture.mixture import Mixture
from restock.replay.plan.plan import PinnedStore
from restock.replay.plan.strata import Stratum
from restock.replay.plan.weights import RatioFit
from restock.replay.sampling.packed_rows import PACKING_VERSION, row_columns, row_width

AGAIN = "make it again with `restock mix`"
SAMPLED_BLOCKS, BLOCK_BYTES = 16, 4096
DIGEST_BYTES = 16
READ_BYTES = 4 << 20


class FileRecord(msgspec.Struct, frozen=True):
    """Size and checksums of a file when it was written."""

    bytes: int
    blake3: str  # checksum of the whole file
    sample: str  # checksum of some of its blocks

    @classmethod
    def of(cls, path: Path) -> FileRecord:
        """Compute the size and checksums of a file."""
        return cls(path.stat().st_size, checksum(path), sample_checksum(path))

    def check(self, path: Path, *, verify: bool) -> None:
        """Raise PanelError if the file changed; only with `verify` is the whole file read."""
        if sys.byteorder != "little":
            raise PanelError("panels need a little-endian machine", where=str(path))
        if not path.is_file():
            raise PanelError("this file of the panel is missing", where=str(path), remedy=AGAIN)
        size = path.stat().st_size
        if size != self.bytes:
            raise PanelError(
                f"it has {size} bytes, not the {self.bytes} that were written",
                where=str(path),
                remedy=AGAIN,
            )
        actual, expected = sample_checksum(path), self.sample
        if verify and actual == expected:
            actual, expected = checksum(path), self.blake3
        if actual != expected:
            raise PanelError(
                f"its checksum is {actual}, not {expected}: it was changed or damaged",
                where=str(path),
                remedy=AGAIN,
            )


def checksum(path: Path) -> str:
    """Compute the BLAKE3 of a file, 32 hex digits, with one thread per processor."""
    digest = blake3(max_threads=blake3.AUTO)
    with path.open("rb") as file:
        while content := file.read(READ_BYTES):
            digest.update(content)
    return digest.hexdigest(DIGEST_BYTES)


def sample_checksum(path: Path) -> str:
    """Return the BLAKE2b of evenly spaced blocks of a file, including both ends, 32 hex digits."""
    digest = hashlib.blake2b(digest_size=DIGEST_BYTES)
    room = max(path.stat().st_size - BLOCK_BYTES, 0)
    with path.open("rb") as file:
        for block in range(SAMPLED_BLOCKS):
            file.seek(room * block // (SAMPLED_BLOCKS - 1))
            digest.update(file.read(BLOCK_BYTES))
    return digest.hexdigest()


T = TypeVar("T", bound=msgspec.Struct)


def seal(header: msgspec.Struct) -> bytes:
    """Encode a header as indented JSON, with a checksum of its values."""
    values = msgspec.to_builtins(header)
    return msgspec.json.format(msgspec.json.encode(values | {"seal": _seal_of(values)}), indent=1)


class _Version(msgspec.Struct):
    packing_version: int | None = None


def packed_by(content: bytes) -> int | None:
    """Return the packing version in a header; None if it cannot be read."""
    try:
        return msgspec.json.decode(content, type=_Version).packing_version
    except (msgspec.DecodeError, ValueError):
        return None


def unseal(content: bytes, kind: type[T], where: Path) -> T:
    """Decode a header from `seal`. Raises PanelError if it is damaged or was edited."""
    try:
        values = msgspec.json.decode(content, type=dict[str, Any])
        given_seal = values.pop("seal", None)
        header = msgspec.convert(values, kind)
    except (msgspec.DecodeError, ValueError) as error:
        raise PanelError(
            f"its header is damaged, or of another version of Restock: {error}",
            where=str(where),
            remedy=AGAIN,
        ) from error
    if given_seal != _seal_of(values):
        raise PanelError(
            "its header was changed after it was written",
            where=str(where),
            remedy="a panel never changes: mix another from a changed mixture",
        )
    return header


def _seal_of(values: dict[str, Any]) -> str:
    encoded = msgspec.json.encode(values, order="sorted")
    return hashlib.blake2b(encoded, digest_size=16).hexdigest()


HEADER, ROWS, META, EVALUATION_SPLIT = (
    "panel.json",
    "rows.f32",
    "meta.parquet",
    "evaluation_split.parquet",
)


class Header(msgspec.Struct, frozen=True):
    """The contents of panel.json."""

    id: str
    store: str  # absolute path or URL of the store; for a table in memory, a name with a hash
    store_version: int  # version of the store's Delta table; -1 for a table in memory
    task_hash: str
    task_json: str  # "" if unknown
    labels_version: str
    observation_size: int
    rows: int
    discount: float
    n_step: int
    packing_version: int
    restock_version: str
    newest_ns: int  # when the source's newest row was logged
    logs_share: float  # share of logged rows in a batch
    conditions: list[str]  # names in order of priority, nominal last
    left_out: dict[str, int]  # reason -> rows of the source that are not in the panel
    effective_rows: float  # effective sample size of the weighted draws
    strata: list[Stratum]
    mixture: Mixture
    others: list[PinnedStore]  # stores besides the first
    ratios: list[RatioFit]  # fits of density ratios, if a correction uses them
    files: dict[str, FileRecord]
    profile: str = ""  # name of the profile by which rows were ingested; "" if unknown
    profile_toml: str = ""  # text of that profile, in case its file is missing; "" if unknown
    as_of_ns: int | None = None  # moment that ages refer to; None without `max_age_days`
    split_by: str = ""  # how the evaluation split was done, a value of `by`; "": as in the mixture
    split_note: str = ""  # what was held out instead of whole groups, or why nothing was
    warnings: list[str] = []  # the warnings of `restock mix`


class Panel:
    """A panel on disk, open for reading. Use `Panel.open(path)`.

    `rows` (n, W) float32 is memory-mapped and read-only. `columns` maps each part of a row to its
    columns. `meta` is a table of n rows of metadata.
    """

    def __init__(self, path: Path, header: Header, rows: NDArray[np.float32]) -> None:
        self.path, self.header, self.rows = path, header, rows
        self.columns = row_columns(header.observation_size)
        self._meta: pa.Table | None = None

    @classmethod
    def open(cls, path: str | Path, *, verify: bool = False) -> Panel:
        """Open a panel. It checks sizes and samples of files, and whole files with `verify`.

        Raises:
            PanelError: not a panel, a damaged one, or one packed by another version.
        """
        path = Path(path)
        if not (path / HEADER).is_file():
            raise PanelError(
                "not a panel" if path.exists() else "no such panel",
                where=str(path),
                remedy="`restock mix STORE --mixture coverage --out PANEL` makes one",
            )
        content = (path / HEADER).read_bytes()
        if (version := packed_by(content)) not in (PACKING_VERSION, None):
            raise PanelError(
                f"was packed by another version of Restock (packing {version}, not"
                f" {PACKING_VERSION})",
                where=str(path),
                remedy=AGAIN,
            )
        header = unseal(content, Header, path / HEADER)
        for name, record in header.files.items():
            record.check(path / name, verify=verify)
        shape = (header.rows, row_width(header.observation_size))
        if header.files[ROWS].bytes != 4 * shape[0] * shape[1]:
            raise PanelError(
                f"{header.files[ROWS].bytes} bytes are not {shape[0]} rows of {shape[1]} float32",
                where=str(path / ROWS),
                remedy=AGAIN,
            )
        return cls(path, header, np.memmap(path / ROWS, np.dtype("<f4"), "r", shape=shape))

    def __len__(self) -> int:
        return self.header.rows

    def __repr__(self) -> str:
        strata = ", ".join(f"{s.name} {s.share:.0%} of {s.rows}" for s in self.strata)
        return f"<Panel {self.id}: {len(self)} rows x {self.rows.shape[1]} float32; {strata}>"

    @property
    def id(self) -> str:
        return self.header.id

    @property
    def store_version(self) -> int:
        return self.header.store_version

    @property
    def task_hash(self) -> str:
        return self.header.task_hash

    @property
    def task(self) -> Task:
        """Return the task that defines these rows; raise PanelError if it is unknown."""
        if not self.header.task_json:
            raise PanelError("it does not contain its task", where=str(self.path))
        try:
            return msgspec.json.decode(self.header.task_json, type=Task)
        except msgspec.MsgspecError as error:
            raise PanelError(
                f"its task cannot be read: {error}",
                where=str(self.path / HEADER),
                remedy=f"a newer Restock wrote it; or {AGAIN}",
            ) from error

    @property
    def observation_size(self) -> int:
        return self.header.observation_size

    @property
    def discount(self) -> float:
        return self.header.discount

    @property
    def splits(self) -> bool:
        """Return whether rows were held out for evaluation."""
        return (self.header.split_by or self.header.mixture.evaluation_split.by) != "none"

    @property
    def n_step(self) -> int:
        return self.header.n_step

    @property
    def strata(self) -> list[Stratum]:
        return self.header.strata

    @property
    def warnings(self) -> list[str]:
        """Return the warnings of `restock mix`.

        For example: a source may be an archive, or the split holds out far more than requested.
        """
        return self.header.warnings

    @property
    def meta(self) -> pa.Table:
        """Return the metadata of each packed row, a table of n rows.

        Columns: transition_id, recording_id, episode_id, step_index, stamp_ns, logged_ns,
        condition, zone, behaviour_policy, behaviour_version, action_probability, action, reward (of
        one step), terminated, truncated, perturbation, robot, site, state_code, probability_of_…
        (to compute weights for other shares), stratum, stratum_code (its index in `strata`),
        horizon, weight.
        """
        if self._meta is None:
            self._meta = self._read(META).unify_dictionaries()
        return self._meta

    def meta_column(self, name: str) -> NDArray[Any]:
        """Read one column of `meta` (n,), without the others.

        Raises:
            PanelError: it has no such column.
        """
        try:
            table = self._read(META, [name]) if self._meta is None else self._meta
        except PanelError:  # no such column, or the file is damaged: then `self.meta` raises again
            table = self.meta
        if name not in table.column_names:
            has = ", ".join(self.meta.column_names)
            what = f"its meta has no column {name!r}"
            raise PanelError(what, where=str(self.path), remedy=f"it has {has}")
        return np.asarray(table[name].to_numpy())

    def _read(self, name: str, columns: Sequence[str] | None = None) -> pa.Table:
        """Read a table of the panel; raise PanelError if it is damaged."""
        return read_table(self.path / name, columns=columns, error=PanelError, remedy=AGAIN)

    @property
    def stratum_code(self) -> NDArray[np.int16]:
        """Return the index of each row's stratum in `strata`, (n,)."""
        return np.asarray(self.meta_column("stratum_code"), np.int16)

    @property
    def weights(self) -> F32:
        """Return each row's importance weight, (n,), with mean 1 over the draws by quota."""
        return np.asarray(self.meta_column("weight"), np.float32)

    def stratum_rows(self) -> list[Ints]:
        """Return the row numbers of each stratum, in order of `strata`."""
        code = self.stratum_code
        return [np.flatnonzero(code == index) for index in range(len(self.strata))]
