"""What a fit found: effective parameters, how well each is known, and what was gained."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import msgspec

from restock.toml import toml_value
from restock.train.twin.physics.perturbation import Perturbation


@dataclass(frozen=True)
class Estimate:
    """One parameter: its value, its 95 % interval, and whether the log told it."""

    name: str
    unit: str
    value: float
    low: float | None
    high: float | None
    fitted: bool  # False: as in the base
    note: str = ""


@dataclass(frozen=True)
class Gap:
    """Of held-out segments: how far replayed and logged position end apart, in metres."""

    horizon_s: float
    segments: int
    before_m: float  # median over the segments, under the base
    after_m: float  # under what was fitted
    low_m: float  # 95 % of the latter, bootstrap over segments
    high_m: float


@dataclass(frozen=True)
class Fit:
    """What a log says of the robot."""

    perturbation: Perturbation
    base: Perturbation
    timestep_s: float
    recordings: tuple[str, ...]
    estimates: tuple[Estimate, ...]
    warnings: tuple[str, ...]
    held_out: tuple[Gap, ...]
    noise: dict[str, dict[str, Any]]  # channel -> unit, before, after: median deviations
    segments: int  # that were fitted
    clusters: int  # that uncertainty was drawn over
    condition: float  # of the information matrix
    left_out: dict[str, int] = field(default_factory=dict)  # segments or steps, by reason
    replays: int = 0
    work_s: float = 0.0

    def describe(self) -> dict[str, Any]:
        """As JSON has it."""
        return {
            **{key: value for key, value in vars(self).items() if key != "base"},
            "perturbation": msgspec.to_builtins(self.perturbation),
            "base": msgspec.to_builtins(self.base),
            "estimates": [vars(item) for item in self.estimates],
            "held_out": [vars(item) for item in self.held_out],
        }

    def toml(self) -> str:
        """The perturbation as TOML that training reads, with what is known of each value."""
        said = {item.name: item for item in self.estimates}
        lines = [
            f"# Effective parameters, fitted to {', '.join(self.recordings)}",
            f"# at a timestep of {self.timestep_s:g} s: {self.segments} segments.",
        ]
        lines += [f"# {warning}" for warning in self.warnings]
        for name, value in msgspec.to_builtins(self.perturbation).items():
            note = ""
            if name in said and said[name].fitted:
                note = f"  # 95 %: {said[name].low:.4g} to {said[name].high:.4g}"
            elif name in said:
                note = "  # not fitted"
            lines.append(f"{name} = {toml_value(value)}{note}")
        return "\n".join(lines) + "\n"
