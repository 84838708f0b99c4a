"""`restock twin fit`: fits effective parameters of the robot to its commands and motion."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from restock.cli import output
from restock.cli.words import Positional
from restock.errors import ConfigError, ExitCode, counted

if TYPE_CHECKING:
    from restock.train.twin.calibration.fitted_twin import FittedTwin


@dataclass
class FitCommand:
    """Fit the twin's robot to a store's logs, and write a perturbation that training uses.

    It drives the logged commands again in the twin, open loop on an empty floor, and searches for
    the friction, payload, wheel radius, track, latency and gain with which the twin moves as the
    robot did: first over the whole ranges on few segments, then by least squares on all. A
    parameter that the log does not identify keeps its value, and the reason is printed. A quarter
    of the log is held out to measure the gap before and after. See docs/robot.md.

    Example: `restock twin fit store/ --out fitted.toml`
    """

    store: Annotated[str, Positional("STORE")]
    """The store."""
    out: Path | None = None
    """The TOML file to write: a perturbation, or a schedule over the robots if each recording is
    fitted separately. Default: print the fit alone. An existing file is not overwritten."""
    parameters: str | None = None
    """The parameters to fit, e.g. latency_s,gain. Default: all except left_friction_scale."""
    recording: tuple[str, ...] = ()
    """Use only these recordings, by their ids."""
    per_recording: bool = False
    """Fit each recording separately, for robots that differ."""
    horizon_s: float = 3.0
    """Length in seconds of the segments that are driven again."""
    segments: int = 200
    """The largest number of segments."""
    task: str | None = None
    """Hash of the task whose rows are used, if the store has several tasks."""
    json: bool = False
    """Print one JSON document: {"fits": [{"estimates", "warnings", "held_out", …}], "out"}."""

    def run(self) -> int:
        """Fit the parameters, print and write them."""
        from restock.files import expect_file_place
        from restock.replay.store.store import Store
        from restock.train.twin.calibration.fitted_twin import write_fit
        from restock.train.twin.calibration.logged_steps import recordings_of

        if self.out is not None and self.out.suffix != ".toml":
            raise ConfigError(
                f"{self.out.name!r} does not end in .toml",
                where="--out",
                remedy="training and evaluation read a perturbation from FILE.toml",
            )
        if self.out is not None and self.out.exists():
            raise ConfigError("already exists", where=str(self.out), remedy="choose another --out")
        expect_file_place(self.out, "--out")
        with Store(self.store) as store:
            groups: list[tuple[str, ...]] = [self.recording]
            if self.per_recording:
                groups = [(name,) for name in recordings_of(store, self.recording, self.task)]
            fits = [self._fit(store, group) for group in groups]
        if self.out is not None:
            write_fit(self.out, fits)
        if self.json:
            output.print_json({"fits": [item.describe() for item in fits], "out": self.out})
        else:
            for item in fits:
                _show(item)
        if self.out is not None:
            output.say(f"wrote {self.out}")
        return ExitCode.OK

    def _fit(self, store: Any, recordings: tuple[str, ...]) -> FittedTwin:
        from restock.train.twin.calibration.fit import FitConfig, fit
        from restock.train.twin.calibration.fit_solver import DEFAULT

        name = "fitted" if self.out is None else self.out.stem
        names = output.names_in(self.parameters or "")
        config = FitConfig(
            parameters=DEFAULT if self.parameters is None else tuple(dict.fromkeys(names)),
            recordings=recordings,
            task_hash=self.task,
            horizon_s=self.horizon_s,
            max_segments=self.segments,
            nthread=0,
            name=f"{name} {recordings[0]}" if self.per_recording else name,
        )
        return fit(store, config, on_progress=output.say)


def _show(fit: FittedTwin) -> None:
    from restock.train.twin.calibration.fit_solver import BASE

    rows = [
        {
            "parameter": item.name,
            "unit": item.unit,
            "before": getattr(BASE, item.name),
            "effective": item.value,
            "95 % from": item.low,
            "to": item.high,
            "": "fitted" if item.fitted else "not fitted",
        }
        for item in fit.estimates
    ]
    title = (
        f"{', '.join(fit.recordings)}  {counted(fit.segments, 'segment')} of "
        f"{counted(fit.clusters, 'cluster')}"
        f"  timestep {BASE.timestep_s:g} s"
    )
    output.print_table(rows, title=title)
    output.print_table(
        [
            {"signal": name, "unit": item["unit"], "before": item["before"], "after": item["after"]}
            for name, item in fit.noise.items()
        ],
        title="median deviation from the log, in the segments fitted",
    )
    if fit.held_out:
        output.print_table(
            [
                {
                    "held out, after s": gap.horizon_s,
                    "segments": gap.segments,
                    "before m": gap.before_m,
                    "after m": gap.after_m,
                    "95 % from": gap.low_m,
                    "to": gap.high_m,
                }
                for gap in fit.held_out
            ],
            title="median distance from the logged position",
        )
    for line in fit.warnings:
        output.print_text(f"warning: {line}")
    if fit.left_out:
        left = ", ".join(_count(reason, count) for reason, count in fit.left_out.items())
        output.print_text(f"left out: {left}")


def _count(reason: str, count: int) -> str:
    kind, _, of_steps = reason.partition("steps: ")
    return (
        f"{counted(count, 'segment')} {kind}" if kind else f"{counted(count, 'step')} ({of_steps})"
    )
