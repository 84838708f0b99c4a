"""What a fit gives: effective parameters, how well each is known, and the TOML that training reads.

One fit makes a perturbation; several, of recordings of robots that differ, a schedule over them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from restock.errors import ConfigError, StoreError
from restock.files import write_text
from restock.toml import toml_value
from restock.train.twin.physics.perturbation import Perturbation, Schedule


@dataclass(frozen=True)
class ParameterEstimate:
    """One parameter: its value, its 95 % interval, and whether the log identified it."""

    name: str
    unit: str
    value: float
    low: float | None
    high: float | None
    fitted: bool  # False: as in the base, for the reason that `note` gives
    note: str = ""


@dataclass(frozen=True)
class HeldOutGap:
    """Of held-out segments: how far replayed and logged position end apart, in metres."""

    horizon_s: float
    segments: int
    before_m: float  # median over the segments, under the base
    after_m: float  # under what was fitted
    low_m: float  # 95 % of the latter, bootstrap over segments
    high_m: float


@dataclass(frozen=True)
class FittedTwin:
    """The twin as a log's robot, as far as the log identifies it."""

    perturbation: Perturbation
    base: Perturbation
    timestep_s: float
    recordings: tuple[str, ...]
    estimates: tuple[ParameterEstimate, ...]
    warnings: tuple[str, ...]
    held_out: tuple[HeldOutGap, ...]
    noise: dict[str, dict[str, Any]]  # channel -> unit, before, after: median deviations
    segments: int  # that were fitted
    clusters: int  # that uncertainty was drawn over
    condition_number: float  # of the information matrix
    left_out: dict[str, int] = field(default_factory=dict)  # segments or steps, by reason
    replays: int = 0
    work_s: float = 0.0

    def describe(self) -> dict[str, Any]:
        """As JSON has it."""
        return {
            **vars(self),
            "perturbation": msgspec.to_builtins(self.perturbation),
            "base": msgspec.to_builtins(self.base),
            "estimates": [vars(item) for item in self.estimates],
            "held_out": [vars(item) for item in self.held_out],
        }

    def toml(self) -> str:
        """The perturbation as TOML that training reads, with what is known of each value."""
        estimates = {item.name: item for item in self.estimates}
        lines = [
            f"# Effective parameters, fitted to {', '.join(self.recordings)}",
            f"# at a timestep of {self.timestep_s:g} s: {self.segments} segments.",
        ]
        lines += [f"# {warning}" for warning in self.warnings]
        for name, value in msgspec.to_builtins(self.perturbation).items():
            note = ""
            if name in estimates and estimates[name].fitted:
                note = f"  # 95 %: {estimates[name].low:.4g} to {estimates[name].high:.4g}"
            elif name in estimates:
                note = "  # not fitted"
            lines.append(f"{name} = {toml_value(value)}{note}")
        return "\n".join(lines) + "\n"


def fleet_schedule(fits: Sequence[FittedTwin]) -> Schedule:
    """A schedule that draws each parameter between its smallest and largest fitted value.

    A parameter that not every recording identified stays as in the base.
    """
    fitted = [{item.name for item in fit.estimates if item.fitted} for fit in fits]
    shared = [
        item.name for item in fits[0].estimates if all(item.name in names for names in fitted)
    ]
    base = msgspec.structs.replace(fits[0].base, timestep_s=fits[0].timestep_s)
    values = {name: [getattr(fit.perturbation, name) for fit in fits] for name in shared}
    middle = {name: float(np.mean(each)) for name, each in values.items()}
    return Schedule(
        ranges={name: (min(each), max(each)) for name, each in values.items()},
        base=msgspec.structs.replace(base, name="fleet", **middle),
        name="fleet",
    )


def write_fit(path: Path | str, fits: Sequence[FittedTwin]) -> None:
    """Write the perturbation of one fit, or the schedule of several, whole or not at all.

    Raises:
        ConfigError: there is something at `path`.
        StoreError: it cannot be written there.
    """
    text = fits[0].toml() if len(fits) == 1 else _schedule_toml(fits)
    try:
        write_text(Path(path), text, exclusive=True)
    except FileExistsError as error:
        raise ConfigError(
            "already exists", where=str(path), remedy="choose another --out"
        ) from error
    except OSError as error:
        raise StoreError(
            f"cannot be written: {error.strerror}", where=str(path), remedy="check the folder"
        ) from error


def _schedule_toml(fits: Sequence[FittedTwin]) -> str:
    made = fleet_schedule(fits)
    lines = [
        f"# Fitted to {len(fits)} recordings, each separately, at {fits[0].timestep_s:g} s.",
        f"name = {toml_value(made.name)}",
        "",
        "[ranges]",
        *(f"{name} = {toml_value(ends)}" for name, ends in made.ranges.items()),
        "",
        "[base]",
    ]
    for name, value in msgspec.to_builtins(made.base).items():
        if value != getattr(Perturbation(), name):
            lines.append(f"{name} = {toml_value(value)}")
    return "\n".join(lines) + "\n"
