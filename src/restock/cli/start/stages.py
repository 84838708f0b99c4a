"""The stages from recordings to a report: what each runs, reads and writes."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from restock.cli.start import outcomes
from restock.cli.start.outcomes import Document

COVERAGE = (
    "SELECT condition, rows_held, held_share, episodes_held, success_share, behaviour_policies"
    " FROM coverage_by_condition"
)


@dataclass(frozen=True)
class Stage:
    """A step between recordings and report: its command, and when to run it again."""

    name: str
    title: str
    command: list[str]
    reads: tuple[Path, ...] = ()  # the user's files: the stage is run again if one changes
    writes: tuple[Path, ...] = ()
    expected: tuple[int, ...] = (0,)  # exit codes after which the next stage runs
    outcome: Callable[[Document], list[str]] = lambda document: []  # summary in a few lines
    shows_progress: bool = False  # for a stage that takes minutes
    resume: tuple[str, ...] = ()  # the command that continues an interrupted stage
    beside: tuple[str, ...] = ()  # a command that runs in parallel

    def line(self) -> str:
        """Return the command as a user types it; first the parallel command, if there is one."""
        beside = f"restock {shlex.join(self.beside)} &\n" if self.beside else ""
        return f"{beside}restock {shlex.join(self.command)}"


@dataclass(frozen=True)
class Settings:
    """The user's files, where results go, and how recordings are read."""

    logs: tuple[str, ...]
    out: Path
    profile: Path | str | None = None  # None: the default of `restock ingest`
    seconds: float = 150.0  # of training time
    episodes: int = 20  # evaluated per kind, policy and perturbation
    kinds: tuple[str, ...] = ()  # kinds of missions; empty: all that the floor has room for
    mixture: str = "coverage"
    definitions: str | None = None  # as `open_recording` takes them
    salvage: bool = False
    tags: tuple[str, ...] = ()  # each KEY=VALUE
    map: Path | None = None
    train: tuple[str, ...] = ()  # further settings, each key=value

    @property
    def store(self) -> Path:
        return self.out / "store"

    @property
    def panel(self) -> Path:
        return self.out / "panel"

    @property
    def run(self) -> Path:
        return self.out / "run"

    @property
    def fitted(self) -> Path:
        return self.out / "fitted.toml"

    @property
    def floor(self) -> Path:
        return self.out / "floor.toml"

    @property
    def episodes_option(self) -> str:
        """Return the number of episodes of each kind, as `restock eval --episodes` takes it."""
        counts = ",".join(f"{kind}={self.episodes}" for kind in self.kinds)
        return counts or str(self.episodes)

    @property
    def definition_options(self) -> list[str]:
        """Return the options that define message types which a recording does not define."""
        return [] if self.definitions is None else ["--definitions", self.definitions]

    @property
    def read_options(self) -> list[str]:
        """Return the options by which recordings are read."""
        return self.definition_options + ["--salvage"] * self.salvage

    @property
    def files_read(self) -> tuple[Path, ...]:
        """Return the user's files that are read by every stage that reads recordings."""
        from restock.ingest.decoding.definitions import choose_definitions

        place = choose_definitions(self.definitions).partition("+")[2]
        return (*map(Path, self.logs), *([Path(place)] if place else []))

    def training(self, panel: Path, run: Path, *budget: str) -> list[str]:
        """Return the command that trains a run, with the options of its budget."""
        settings = (word for setting in self.train for word in ("--set", setting))
        return ["train", "--panel", str(panel), "--out", str(run), *budget, *settings]


def own_file(name: Path | str | None) -> tuple[Path, ...]:
    """Return the user's file, in a tuple; empty if the name is None or that of a shipped file."""
    return () if name is None or not Path(name).is_file() else (Path(name),)


def info(to: Settings) -> Stage:
    return Stage(
        "info",
        "What is in these recordings?",
        ["info", *to.logs, *to.read_options],
        reads=to.files_read,
        expected=(0, 3),  # 3: the recording is damaged; its intact part was read
        outcome=outcomes.info,
    )


def propose(
    to: Settings, recordings: tuple[str, ...], flags: list[str], urdf: Path | None = None
) -> Stage:
    """Propose one profile from these recordings."""
    return Stage(
        "propose",
        "How do its topics become observation, action and reward?",
        ["profile", "new", *recordings, "--out", str(to.profile), *flags, *to.read_options],
        reads=(*to.files_read, *own_file(urdf)),
        writes=(Path(str(to.profile)),),
        expected=(0, 3),
        outcome=outcomes.propose,
    )


def check(to: Settings, recording: str) -> Stage:
    return Stage(
        "check",
        "Does the profile fit?",
        ["profile", "check", str(to.profile), recording, *to.read_options],
        reads=own_file(to.profile),
        expected=(0, 3),  # 3: data was lost; ingest reports it for all recordings
        outcome=outcomes.check,
    )


def ingest(to: Settings) -> Stage:
    profile = [] if to.profile is None else ["--profile", str(to.profile)]
    tags = [word for tag in to.tags for word in ("--tag", tag)]
    return Stage(
        "ingest",
        "Recordings to labelled transitions",
        ["ingest", *to.logs, "--store", str(to.store), *profile, *to.read_options, *tags],
        reads=(*to.files_read, *own_file(to.profile)),
        writes=(to.store,),
        expected=(0, 3),
        outcome=outcomes.ingest,
    )


def coverage(to: Settings) -> Stage:
    command = ["sql", str(to.store), COVERAGE]
    return Stage("coverage", "What do the logs cover?", command, outcome=outcomes.coverage)


def audit(to: Settings) -> Stage:
    command, title = ["audit", str(to.store)], "Is the coverage good enough?"
    return Stage("audit", title, command, expected=(0, 1), outcome=outcomes.audit)


def mix(to: Settings) -> Stage:
    return Stage(
        "mix",
        "A replay panel that keeps the rare conditions in stock",
        ["mix", str(to.store), "--mixture", to.mixture, "--out", str(to.panel)],
        reads=own_file(to.mixture),
        writes=(to.panel,),
        outcome=outcomes.mix,
    )


def floor(to: Settings) -> Stage:
    """Make the twin's floor from the user's map, else from scans, or else from the path driven."""
    given = () if to.map is None else ("--map", str(to.map))
    picture = to.floor.with_suffix(".png")
    words = ("twin", "layout", "--from", str(to.store), *given, *to.definition_options)
    return Stage(
        "floor",
        "The floor, as the recordings show it",
        [*words, "--out", str(to.floor), "--out", str(picture)],
        reads=own_file(to.map),
        writes=(to.floor, picture),
        outcome=outcomes.floor,
    )


def fit(to: Settings, horizon_s: float) -> Stage:
    """Fit the twin's robot to the logs, with few segments to save time."""
    few = ("--segments", "80", "--horizon-s", f"{horizon_s:g}")
    return Stage(
        "fit",
        "The twin's robot, fitted to these logs",
        ["twin", "fit", str(to.store), "--out", str(to.fitted), *few],
        writes=(to.fitted,),
        outcome=outcomes.fit,
    )


def gap(to: Settings, horizon_s: float, *, fitted: bool) -> Stage:
    """Measure how far the twin and the logged robot drift apart under the same commands."""
    calibrated = ("--perturbation", str(to.fitted)) if fitted else ()
    few = ("--segments", "100", "--horizon-s", f"{horizon_s:g}")
    folder = to.store / "gap"
    return Stage(
        "gap",
        "Can the twin be trusted?",
        ["twin", "gap", str(to.store), *calibrated, "--out", str(folder), *few],
        writes=(folder,),
        outcome=outcomes.gap,
    )


def train(to: Settings, *, twin: bool = True) -> Stage:
    """Train offline and then in the twin, or on the logs alone."""
    online = "Train: first on the panel, then online in the twin"
    budget = ("--seconds", f"{to.seconds:g}") if twin else ()
    return Stage(
        "train",
        online if twin else "Train on the logs alone, without a twin",
        to.training(to.panel, to.run, *budget),
        writes=(to.run,),
        outcome=outcomes.train,
        shows_progress=True,
        resume=("train", "--resume", str(to.run)),
    )


def evaluate(to: Settings, *policies: str) -> Stage:
    """Evaluate in the twin, beside the planner, a random policy and any given `policies`."""
    named = ("--policies", ",".join(("agent", *policies, "planner", "random"))) if policies else ()
    return Stage(
        "eval",
        "Evaluate on the same seeded episodes",
        ["eval", str(to.run), "--episodes", to.episodes_option, *named],
        outcome=outcomes.driven,
        shows_progress=True,
    )


def judge(to: Settings) -> Stage:
    """Evaluate off-policy, on logs that the policy did not learn from."""
    return Stage(
        "judge",
        "How good is the policy, by the logs alone, compared with their drivers?",
        ["eval", str(to.run), "--on-logs", "own"],
        outcome=outcomes.on_logs,
        shows_progress=True,
    )


def report(to: Settings) -> Stage:
    page = (to.run / "report.html",)
    return Stage("report", "One page with all results", ["report", str(to.run)], writes=page)
