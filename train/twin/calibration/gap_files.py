"""A measured gap as a folder: `gap.json`, and its rows as Parquet for any tool that reads it."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from restock.errors import RunError
from restock.files import write_table, write_text
from restock.stats import ConfidenceInterval
from restock.train.twin.calibration.gap import Gap
from restock.train.twin.calibration.trust import Verdict

FORMAT = "restock-twin-gap/1"
DOCUMENT = "gap.json"
FOLDER = "gap"  # where a report looks for it, in a run's directory or a store's
_F, _I, _S = pa.float64(), pa.int64(), pa.string()


def _interval(name: str) -> list[tuple[str, pa.DataType]]:
    return [(name, _F), (f"{name}_low", _F), (f"{name}_high", _F)]


TABLES: dict[str, pa.Schema] = {
    "paths": pa.schema(
        [
            *(("condition", _S), ("horizon_s", _F), ("quantity", _S), ("unit", _S)),
            *(("source", _S), ("segments", _I), ("episodes", _I)),
            *(*_interval("median"), *_interval("p90")),
        ]
    ),
    "observations": pa.schema(
        [
            *(("condition", _S), ("component", _S), ("source", _S), ("steps", _I)),
            *_interval("mean_gap"),
        ]
    ),
    "rewards": pa.schema(
        [
            *(("condition", _S), ("term", _S), ("source", _S), ("steps", _I)),
            *_interval("mean_gap"),
            *(("bias", _F), ("logged_mean", _F), ("logged_spread", _F)),
        ]
    ),
}


def check_place(folder: Path) -> None:
    """Raises RunError where `folder` is something else than a gap measured before."""
    if folder.exists() and not (folder.is_dir() and (folder / DOCUMENT).is_file()):
        if folder.is_dir() and not any(folder.iterdir()):
            return
        raise RunError("is there already", where=str(folder), remedy="name another --out")


def write_gap(gap: Gap, folder: Path) -> None:
    """Write a gap; one measured before is replaced.

    Raises:
        RunError: there is something else at `folder`.
    """
    check_place(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for name, rows in _tables(gap).items():
        write_table(pa.Table.from_pylist(rows, TABLES[name]), folder / f"{name}.parquet")
    document = {
        "format": FORMAT,
        "about": gap.about,
        "verdicts": [_verdict(found) for found in gap.verdicts],
        "not_done": list(gap.not_done),
    }
    write_text(folder / DOCUMENT, json.dumps(document, indent=1) + "\n")


def read_gap(folder: Path) -> Gap:
    """Read what `write_gap` wrote.

    Raises:
        RunError: there is none, or it cannot be read.
    """
    try:
        document = json.loads((folder / DOCUMENT).read_text(encoding="utf-8"))
        if document.get("format") != FORMAT:
            raise ValueError(f"its format is {document.get('format')!r}, not {FORMAT!r}")
        tables = {name: pq.read_table(folder / f"{name}.parquet").to_pylist() for name in TABLES}
        verdicts = tuple(_as_verdict(found) for found in document["verdicts"])
        return Gap(
            document["about"],
            tables["paths"],
            tables["observations"],
            tables["rewards"],
            verdicts,
            tuple(document["not_done"]),
        )
    except (OSError, ValueError, KeyError, TypeError, pa.ArrowException) as error:
        raise RunError(
            f"no gap that can be read: {error}",
            where=str(folder),
            remedy=f"`restock twin gap STORE --out {folder}` measures one",
        ) from error


def _tables(gap: Gap) -> dict[str, list[dict[str, Any]]]:
    return {"paths": gap.paths, "observations": gap.observations, "rewards": gap.rewards}


def _verdict(found: Verdict) -> dict[str, Any]:
    """As JSON has it: NaN, which it does not know, as null."""
    values = asdict(found)
    for name in ("position_p90", "reward_ratio"):
        values[name] = {k: None if v != v else v for k, v in values[name].items()}
    return values


def _as_verdict(values: dict[str, Any]) -> Verdict:
    read = dict(values)
    for name in ("position_p90", "reward_ratio"):
        known = {k: float("nan") if v is None else float(v) for k, v in values[name].items()}
        read[name] = ConfidenceInterval(**known)
    return Verdict(**{**read, "reasons": tuple(values["reasons"])})
