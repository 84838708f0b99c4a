"""A traced row's moment, written to an MCAP file that Foxglove and Rerun open."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from restock.errors import ConfigError, StoreError
from restock.files import temporary_name, write_text
from restock.replay.trace.moment import Moment, find_moment
from restock.replay.trace.trace import Trace
from restock.train.view.critic import Critic, critic_along
from restock.train.view.layout import foxglove_layout
from restock.train.view.mcap_view import write_mcap

if TYPE_CHECKING:  # it needs the twin and its physics
    from restock.train.view.evaluated import Beside


@dataclass(frozen=True)
class ViewOptions:
    """How much of a moment is shown, and by which critic."""

    before_s: float = 5.0
    after_s: float = 5.0
    recording: Path | str | None = None  # scans, plans and all other topics are in it
    profile: str | None = None
    critic: str | None = None  # a run
    beside: str | None = None  # CONDITION/SEED of an episode of the evaluation of `beside_run`
    beside_run: Path | str | None = None


def write_view(
    trace: Trace, path: Path | str, options: ViewOptions | None = None
) -> dict[str, Any]:
    """Write the seconds around a traced row; returns what is in the file.

    Args:
        trace: of a row that lies in a store.
        path: a new file, `.mcap`; a layout for Foxglove is put beside it.

    Raises:
        ConfigError: another ending, there is a file already, or the evaluation has no such
            episode.
        RunError: driven again that episode is not the recorded one.
        StoreError: the row is of the twin: no store has what was before and after it.
    """
    options, path = options or ViewOptions(), Path(path)
    check_view(path)
    if trace.origin is None:
        raise StoreError(
            "is a row from the twin, so there is no recording of it",
            where="--view",
            remedy="`restock twin record --policy run:RUN --missions FILE` drives it again",
        )
    moment = find_moment(
        trace.origin,
        before_s=options.before_s,
        after_s=options.after_s,
        recording=options.recording,
        profile=options.profile,
    )
    critic = critic_along(options.critic, moment) if options.critic is not None else None
    beside = _beside(options, moment)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = temporary_name(path).with_suffix(path.suffix)
    try:
        counts, layout = _write(temporary, moment, critic, beside)
        write_text(layout_of(path), json.dumps(layout, indent=1) + "\n")
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    return {
        "path": str(path),
        "layout": str(layout_of(path)),
        "steps": len(moment.steps),
        "seconds": (moment.window_ns[1] - moment.window_ns[0]) / 1e9,
        "critic": None if critic is None else f"{critic.run}: {critic.weights}",
        "beside": None if beside is None else beside.evaluated.outcome,
        "topics": counts,
        "notes": moment.notes,
    }


def check_view(path: Path) -> None:
    """Raises ConfigError where nothing can be written to `path`: before anything is looked up."""
    if path.suffix != ".mcap":
        raise ConfigError(
            f"{path.name!r} must end in .mcap",
            where="--view",
            remedy="choose another name: Foxglove and Rerun open it",
        )
    if path.exists():
        raise ConfigError(
            "exists already", where=str(path), remedy="remove it, or choose another name"
        )


def layout_of(path: Path) -> Path:
    """Where the Foxglove layout of a file lies."""
    return path.with_suffix(".foxglove.json")


def _beside(options: ViewOptions, moment: Moment) -> Beside | None:
    """The episode of the evaluation that was asked for, from the moment's beginning on."""
    if options.beside is None:
        return None
    if options.beside_run is None:
        raise ConfigError(
            "is an episode of an evaluation, so its run is needed",
            where="--beside",
            remedy="give the run with --critic RUN",
        )
    from restock.train.view.evaluated import Beside, evaluated_moment

    run = Path(options.beside_run)
    evaluated = evaluated_moment(run, options.beside, begins_ns=moment.window_ns[0])
    along = None if options.critic is None else critic_along(options.critic, evaluated.moment)
    return Beside(evaluated, along)


def _write(
    path: Path, moment: Moment, critic: Critic | None, beside: Beside | None
) -> tuple[dict[str, int], dict[str, Any]]:
    with path.open("wb") as stream:
        written = write_mcap(stream, moment, critic, beside)
    middle = float(moment.at["pose_x_m"]), float(moment.at["pose_y_m"])
    types = {topic: kind for topic, (kind, _) in written.items()}
    counts = {topic: count for topic, (_, count) in written.items()}
    floors = {"moment": ("map", middle)}
    if beside is not None:
        first = beside.evaluated.moment.at
        floors["evaluation"] = (
            "evaluation_map",
            (float(first["pose_x_m"]), float(first["pose_y_m"])),
        )
    return counts, foxglove_layout(types, floors)
