"""What a fit leaves behind: a perturbation, or a schedule over the robots of a fleet, as TOML."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np

from restock.errors import ConfigError, StoreError
from restock.toml import toml_value
from restock.train.twin.calibration.fit_result import Fit
from restock.train.twin.physics.perturbation import Perturbation, Schedule


def schedule(fits: Sequence[Fit]) -> Schedule:
    """A schedule that draws each parameter between its smallest and largest fitted value.

    A parameter that not every recording told stays as in the base.
    """
    told = [{item.name for item in fit.estimates if item.fitted} for fit in fits]
    shared = [item.name for item in fits[0].estimates if all(item.name in names for names in told)]
    base = msgspec.structs.replace(fits[0].base, timestep_s=fits[0].timestep_s)
    values = {name: [getattr(fit.perturbation, name) for fit in fits] for name in shared}
    middle = {name: float(np.mean(found)) for name, found in values.items()}
    return Schedule(
        ranges={name: (min(found), max(found)) for name, found in values.items()},
        base=msgspec.structs.replace(base, name="fleet", **middle),
        name="fleet",
    )


def write_fit(path: Path, fits: Sequence[Fit]) -> None:
    """Write the perturbation of one fit, or the schedule of several, whole or not at all.

    Raises:
        ConfigError: there is something at `path`.
        StoreError: it cannot be written there.
    """
    text = fits[0].toml() if len(fits) == 1 else _schedule_toml(fits)
    part = path.with_name(f".{path.name}.part")
    try:
        part.write_text(text, encoding="utf-8")
        os.link(part, path)
    except FileExistsError as error:
        raise ConfigError(
            "is there already", where=str(path), remedy="name another --out"
        ) from error
    except OSError as error:
        raise StoreError(
            f"cannot be written: {error.strerror}", where=str(path), remedy="check the folder"
        ) from error
    finally:
        part.unlink(missing_ok=True)


def _schedule_toml(fits: Sequence[Fit]) -> str:
    made = schedule(fits)
    lines = [
        f"# Fitted to {len(fits)} recordings, each by itself, at {fits[0].timestep_s:g} s.",
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
