"""A measured gap: settings, rows, a verdict on each condition, and the folder it is kept in.

The folder has `gap.json`, and the rows as Parquet files.

A condition is `untrusted` if the twin is shown to be beyond a limit, and `trusted` if it is shown
to be within, both by the end of a 95 % interval. It is `undecided` if the interval contains the
limit, and `unknown` if too little was driven.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from restock.errors import ConfigError, RunError, quoted
from restock.files import write_table, write_text
from restock.stats import ConfidenceInterval

Rows = list[dict[str, Any]]

TRUSTED, UNTRUSTED = "trusted", "untrusted"
UNDECIDED, UNKNOWN = "undecided", "unknown"

FORMAT = "restock-twin-gap/1"
DOCUMENT = "gap.json"
FOLDER = "gap"  # in the directory of a run or store, for reports and gates
_F, _I, _S = pa.float64(), pa.int64(), pa.string()


def _interval(name: str) -> dict[str, pa.DataType]:
    return {name: _F, f"{name}_low": _F, f"{name}_high": _F}


TABLES: dict[str, pa.Schema] = {
    "paths": pa.schema(
        {"condition": _S, "horizon_s": _F, "quantity": _S, "unit": _S, "source": _S}
        | {"segments": _I, "episodes": _I, **_interval("median"), **_interval("p90")}
    ),
    "observations": pa.schema(
        {"condition": _S, "component": _S, "source": _S, "steps": _I, **_interval("mean_gap")}
    ),
    "rewards": pa.schema(
        {"condition": _S, "term": _S, "source": _S, "steps": _I, **_interval("mean_gap")}
        | {"bias": _F, "logged_mean": _F, "logged_spread": _F}
    ),
}


@dataclass(frozen=True)
class TrustLimits:
    """Limits that a twin must keep to be trusted in a condition."""

    horizon_s: float = 3.0
    position_m: float = 0.2  # limit for the 90th percentile of position gaps at `horizon_s`
    reward_ratio: float = 1.0  # one-step reward gap over the reward's spread
    segments: int = 20  # with fewer segments or episodes the verdict is "unknown"
    episodes: int = 5


@dataclass(frozen=True)
class GapConfig:
    """Settings of a gap measurement. Raises ConfigError if they allow no verdict."""

    horizons_s: tuple[float, ...] = (1.0, 3.0, 6.0)  # must include `limits.horizon_s`
    max_segments: int = 400  # per condition and horizon; one-step gaps use 5 times as many steps
    limits: TrustLimits = TrustLimits()
    seed: int = 0
    timestep_s: float = 0.01
    nthread: int = 1  # 0: every core

    def __post_init__(self) -> None:
        where, limits = "gap of the twin", self.limits
        if limits.horizon_s not in self.horizons_s or min(self.horizons_s) <= 0:
            raise ConfigError(f"a horizon of {limits.horizon_s:g} s is not driven", where=where)
        if self.max_segments < 1 or limits.position_m < 0:
            raise ConfigError(
                f"got {self.max_segments} segments and a limit of {limits.position_m:g} m",
                where=where,
                remedy="give at least one segment, and a limit of at least 0",
            )


@dataclass(frozen=True)
class Verdict:
    """A verdict on whether the twin can be trusted in one condition, and why."""

    condition: str
    verdict: str
    reasons: tuple[str, ...]
    segments: int
    episodes: int
    position_p90: ConfidenceInterval  # 90th percentile in m, at the limits' horizon
    reward_ratio: ConfidenceInterval


def trust_verdict(
    condition: str,
    *,
    limits: TrustLimits,
    segments: int,
    episodes: int,
    position_p90: ConfidenceInterval,
    reward_ratio: ConfidenceInterval,
) -> Verdict:
    """Judge one condition; an unknown reward ratio is ignored."""
    beyond, open_ = [], []
    for interval, limit, reason in (
        (
            position_p90,
            limits.position_m,
            f"one segment in ten ends {position_p90.value:.2f} m"
            f" [{position_p90.low:.2f}, {position_p90.high:.2f}] or more from the log after"
            f" {limits.horizon_s:g} s; the limit is {limits.position_m:g} m",
        ),
        (
            reward_ratio,
            limits.reward_ratio,
            f"its one-step reward is off by {reward_ratio.value:.2f}"
            f" [{reward_ratio.low:.2f}, {reward_ratio.high:.2f}] times the reward's own spread;"
            f" the limit is {limits.reward_ratio:g}",
        ),
    ):
        if interval is reward_ratio and math.isnan(interval.value):
            continue
        if interval.low > limit:
            beyond.append(reason)
        elif not interval.high <= limit:
            open_.append(reason)
    verdict = UNTRUSTED if beyond else UNDECIDED if open_ else TRUSTED
    reasons = beyond or open_
    few = [
        f"{there} of at least {least} {what}"
        for there, least, what in (
            (segments, limits.segments, f"segments of {limits.horizon_s:g} s"),
            (episodes, limits.episodes, "episodes with one"),
        )
        if there < least
    ]
    if few:
        verdict, reasons = UNKNOWN, [f"too few: {', '.join(few)}"]
    return Verdict(
        condition, verdict, tuple(reasons), segments, episodes, position_p90, reward_ratio
    )


@dataclass(frozen=True)
class TwinGap:
    """A measured gap. Rows are plain values; statistics have 95 % intervals over episodes."""

    about: dict[str, Any]  # store, version, task, twins, limits, floor, counts
    paths: Rows  # condition, horizon_s, quantity, unit, source, segments, episodes, median, p90 …
    observations: Rows  # condition, component, source, steps, mean_gap, low, high
    rewards: Rows  # condition, term, source, steps, mean_gap, low, high, bias, spread
    verdicts: tuple[Verdict, ...]
    not_done: tuple[str, ...]  # comparisons that were not possible, in sentences

    @property
    def untrusted(self) -> list[str]:
        """Return the conditions in which the twin should not be trusted."""
        return [item.condition for item in self.verdicts if item.verdict == UNTRUSTED]

    def document(self) -> dict[str, Any]:
        """Return the gap as plain values for JSON."""
        return {
            "about": self.about,
            "untrusted": self.untrusted,
            "verdicts": [asdict(item) for item in self.verdicts],
            "not_done": list(self.not_done),
            **{name: getattr(self, name) for name in TABLES},
        }


def check_place(folder: Path) -> None:
    """Raise RunError if `folder` has anything but an earlier gap."""
    if folder.exists() and not (folder.is_dir() and (folder / DOCUMENT).is_file()):
        if folder.is_dir() and not any(folder.iterdir()):
            return
        raise RunError("already exists", where=str(folder), remedy="choose another --out")


def write_gap(gap: TwinGap, folder: Path | str) -> None:
    """Write a gap, replacing an earlier one.

    Raises:
        RunError: `folder` has something else.
    """
    folder = Path(folder)
    check_place(folder)
    for name, schema in TABLES.items():
        rows = getattr(gap, name)
        write_table(pa.Table.from_pylist(rows, schema), folder / f"{name}.parquet")
    document = {
        "format": FORMAT,
        "about": gap.about,
        "verdicts": [_verdict_document(item) for item in gap.verdicts],
        "not_done": list(gap.not_done),
    }
    write_text(folder / DOCUMENT, json.dumps(document, indent=1) + "\n")


def gap_folder(places: Iterable[Path]) -> Path | None:
    """Return the `gap` folder of the first run or store in `places` that has a gap; else None."""
    return next((place / FOLDER for place in places if (place / FOLDER / DOCUMENT).is_file()), None)


def read_gap(folder: Path) -> TwinGap:
    """Read a gap that `write_gap` wrote.

    Raises:
        RunError: there is no gap in `folder`, or it cannot be read.
    """
    remedy = f"`restock twin gap STORE --out {quoted(folder)}` measures one"
    if not (folder / DOCUMENT).exists():
        raise RunError("no gap of the twin has been measured", where=str(folder), remedy=remedy)
    try:
        document = json.loads((folder / DOCUMENT).read_text(encoding="utf-8"))
        if document.get("format") != FORMAT:
            raise ValueError(f"its format is {document.get('format')!r}, not {FORMAT!r}")
        tables = {name: pq.read_table(folder / f"{name}.parquet").to_pylist() for name in TABLES}
        return TwinGap(
            about=document["about"],
            **tables,
            verdicts=tuple(_read_verdict(item) for item in document["verdicts"]),
            not_done=tuple(document["not_done"]),
        )
    except (OSError, ValueError, KeyError, TypeError, pa.ArrowException) as error:
        raise RunError(
            f"it contains no readable gap: {error}",
            where=str(folder),
            remedy=remedy,
        ) from error


_INTERVALS = ("position_p90", "reward_ratio")


def _verdict_document(verdict: Verdict) -> dict[str, Any]:
    """Return a verdict for JSON, with null for NaN."""
    values = asdict(verdict)
    for name in _INTERVALS:
        values[name] = {k: None if math.isnan(v) else v for k, v in values[name].items()}
    return values


def _read_verdict(values: dict[str, Any]) -> Verdict:
    read = values | {"reasons": tuple(values["reasons"])}
    for name in _INTERVALS:
        ends = {k: math.nan if v is None else float(v) for k, v in values[name].items()}
        read[name] = ConfidenceInterval(**ends)
    return Verdict(**read)
