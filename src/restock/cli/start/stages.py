"""The stages from recordings to a report: one list of them, for `start` and for `demo`."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from restock.cli.start import outcomes
from restock.cli.start.outcomes import Document

COVERAGE = (
    "SELECT condition, rows_held, held_share, episodes_held, success_share, behaviour_policies"
    " FROM coverage_by_condition"
)

UPDATES = 2000  # for a policy from the logs alone, as many as before driving in the twin


def nothing(document: Document) -> list[str]:
    """Return no lines, for a stage whose output says enough."""
    return []


@dataclass(frozen=True)
class Stage:
    """A command of the way from recordings to a report, and when to run it again."""

    name: str
    title: str
    why: str  # shown by `restock demo`, which explains
    command: list[str]
    reads: tuple[Path, ...] = ()  # the user's files: the stage is run again if one changes
    writes: tuple[Path, ...] = ()
    expected: tuple[int, ...] = (0,)  # exit codes after which the next stage runs
    outcome: Callable[[Document], list[str]] = nothing  # in a line or two
    shows_progress: bool = False  # it takes minutes
    resume: tuple[str, ...] = ()  # the command that continues an interrupted stage
    beside: tuple[str, ...] = ()  # a command that runs at the same time
    # The command if it depends on earlier stages; None: there is nothing to do.
    decided: Callable[[], list[str] | None] | None = None

    def line(self) -> str:
        """Return the command as it is typed, below the one that runs beside it."""
        beside = f"restock {shlex.join(self.beside)} &\n" if self.beside else ""
        return f"{beside}restock {shlex.join(self.command)}"


@dataclass(frozen=True)
class Stop:
    """A point where a person must decide, and what that person can do."""

    why: str
    remedies: tuple[str, ...]  # each something to type or to edit


@dataclass(frozen=True)
class Settings:
    """The user's files, where results go, and how recordings are read."""

    logs: tuple[str, ...]
    out: Path
    profile: Path | str | None = None  # None: that of the shipped robot
    seconds: float = 150.0  # of training time
    episodes: int = 20  # evaluated per kind, policy and perturbation
    kinds: tuple[str, ...] = ()  # kinds of missions; none: all that the floor has room for
    device: str = "cpu"
    mixture: str = "coverage"
    definitions: str | None = None  # as `open_recording` takes them
    salvage: bool = False
    tags: tuple[str, ...] = ()  # each KEY=VALUE
    map: Path | None = None
    further_floors: tuple[Path, ...] = ()  # for recordings in other frames
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
    def logs_alone(self) -> Path:
        """Return the run that never drives, to compare fine-tuning with."""
        return self.out / "logs-alone"

    @property
    def uniform_panel(self) -> Path:
        return self.out / "panel-uniform"

    @property
    def uniform(self) -> Path:
        """Return the run that is fed the logs as they are."""
        return self.out / "fed-uniformly"

    @property
    def fitted(self) -> Path:
        return self.out / "fitted.toml"

    @property
    def floor(self) -> Path:
        return self.out / "floor.toml"

    @property
    def layouts(self) -> str:
        """Return all floors, as a run's config and evaluations take them."""
        return ",".join(map(str, (self.floor, *self.further_floors)))

    @property
    def of_each_kind(self) -> str:
        """Return the number of episodes of each kind, as `restock eval --episodes` takes it."""
        counts = ",".join(f"{kind}={self.episodes}" for kind in self.kinds)
        return counts or str(self.episodes)

    @property
    def recordings(self) -> tuple[Path, ...]:
        """Return the user's files and folders."""
        return tuple(Path(path) for path in self.logs)

    @property
    def with_profile(self) -> list[str]:
        return [] if self.profile is None else ["--profile", str(self.profile)]

    @property
    def with_definitions(self) -> list[str]:
        """Return the options that define message types which a recording does not define."""
        return [] if self.definitions is None else ["--definitions", self.definitions]

    @property
    def reading(self) -> list[str]:
        """Return the options by which recordings are read."""
        return self.with_definitions + ["--salvage"] * self.salvage

    @property
    def read(self) -> tuple[Path, ...]:
        """Return the user's files that every stage reads which reads a recording."""
        from restock.ingest.decoding.definitions import choose_definitions

        place = choose_definitions(self.definitions).partition("+")[2]
        return (*self.recordings, *([Path(place)] if place else []))

    @property
    def profile_file(self) -> tuple[Path, ...]:
        return own_file(self.profile)

    @property
    def mixture_file(self) -> tuple[Path, ...]:
        return own_file(self.mixture)


def own_file(name: Path | str | None) -> tuple[Path, ...]:
    """Return the file of this name, unless it is the name of a shipped one."""
    return () if name is None or not Path(name).is_file() else (Path(name),)


def record(logs: Path) -> Stage:
    return Stage(
        "record",
        "Record",
        "This installation has no sample recordings: a simulated robot records some.",
        ["twin", "record", "--out", str(logs / "sample.mcap"), "--missions", "60"],
        writes=(logs,),
    )


def info(to: Settings) -> Stage:
    return Stage(
        "info",
        "What is in these recordings?",
        "The recordings come first: topics, types, counts, durations.",
        ["info", *to.logs, *to.reading],
        reads=to.read,
        expected=(0, 3),  # 3: damaged, and read as far as it is intact
        outcome=outcomes.info,
    )


def propose(
    to: Settings, recordings: tuple[str, ...], flags: list[str], urdf: Path | None = None
) -> Stage:
    """Propose one profile from these recordings."""
    assert to.profile is not None
    return Stage(
        "propose",
        "How do its topics become observation, action and reward?",
        "A first profile is proposed from what is in the recordings.",
        ["profile", "new", *recordings, "--out", str(to.profile), *flags, *to.reading],
        reads=(*to.read, *own_file(urdf)),
        writes=(Path(to.profile),),
        expected=(0, 3),
        outcome=outcomes.propose,
    )


def check(to: Settings, recording: str) -> Stage:
    return Stage(
        "check",
        "Does the profile fit?",
        "A dry run of one recording: what is used, what is missing, and how many transitions "
        "would result.",
        ["profile", "check", str(to.profile), recording, *to.reading],
        reads=to.profile_file,
        expected=(0, 3),  # 3: data was lost, which ingest says of all recordings
        outcome=outcomes.check,
    )


def ingest(to: Settings) -> Stage:
    tags = [word for tag in to.tags for word in ("--tag", tag)]
    return Stage(
        "ingest",
        "Recordings to labelled transitions",
        "Topics become steps of the control clock (held causally, never interpolated). Steps "
        "become observations, actions and rewards, and SQL labels each step with its conditions."
        " If recordings contain the true condition, the labels are scored.",
        [
            *("ingest", *to.logs, "--store", str(to.store)),
            *(*to.with_profile, *to.reading, *tags),
        ],
        reads=(*to.read, *to.profile_file),
        writes=(to.store,),
        expected=(0, 3),
        outcome=outcomes.ingest,
    )


def coverage(to: Settings) -> Stage:
    return Stage(
        "coverage",
        "What do the logs cover?",
        "Hours of the easy aisle, seconds of the wet floor: the store is plain Parquet, and the "
        "query is plain SQL.",
        ["sql", str(to.store), COVERAGE],
        outcome=outcomes.coverage,
    )


def audit(to: Settings) -> Stage:
    return Stage(
        "audit",
        "Is the coverage good enough?",
        "Each audit is a query that returns the offending rows. In a pipeline the exit code"
        " stops you here.",
        ["audit", str(to.store)],
        expected=(0, 1),
        outcome=outcomes.audit,
    )


def mix(to: Settings) -> Stage:
    return Stage(
        "mix",
        "A replay panel that keeps the rare conditions in stock",
        "Each stratum holds the whole episodes that met its condition, and gets its share of "
        "every batch. The result is a pinned panel with an id.",
        ["mix", str(to.store), "--mixture", to.mixture, "--out", str(to.panel)],
        reads=to.mixture_file,
        writes=(to.panel,),
        outcome=outcomes.mix,
    )


def mix_uniform(to: Settings) -> Stage:
    """Mix the logs as they are, to compare quotas with."""
    return Stage(
        "mix-uniform",
        "The same logs as they are, to compare with",
        "Every row has the same probability; strata are only used for the statistics.",
        ["mix", str(to.store), "--mixture", "uniform", "--out", str(to.uniform_panel)],
        writes=(to.uniform_panel,),
    )


def floor(to: Settings) -> Stage:
    """Make the twin's floor from the user's map, else from scans, else from the path driven."""
    given = () if to.map is None else ("--map", str(to.map))
    return _floor(
        to, to.floor, "The floor, as the recordings show it",
        "Made from the map in the recordings, else from their scans, else from the path that was "
        "driven.", given,
    )  # fmt: skip


def further_floor(to: Settings, recording: str, made: Path) -> Stage:
    """Make the floor of a recording whose poses are in a frame of their own."""
    return _floor(
        to, made, "The floor of another frame",
        f"The poses of {Path(recording).name} are in a frame of their own: its routes are on a "
        "floor of their own.", ("--recording", recording),
    )  # fmt: skip


def _floor(to: Settings, made: Path, title: str, why: str, given: Sequence[str]) -> Stage:
    picture = made.with_suffix(".png")
    return Stage(
        made.stem,
        title,
        why,
        [
            *("twin", "layout", "--from", str(to.store), *given, *to.with_definitions),
            *("--out", str(made), "--png", str(picture)),
        ],
        reads=() if to.map is None else own_file(to.map),
        writes=(made, picture),
        outcome=outcomes.floor,
    )


def fit(to: Settings, horizon_s: float) -> Stage:
    """Fit the twin's robot to what the robot did; by few segments, as minutes matter."""
    few = ["--segments", "80", "--horizon-s", f"{horizon_s:g}"]
    return Stage(
        "fit",
        "The twin's robot, fitted to these logs",
        "The logged commands are driven again in the twin, to find the parameters with which it "
        "moves as the robot did.",
        ["twin", "fit", str(to.store), "--out", str(to.fitted), *few],
        writes=(to.fitted,),
        outcome=outcomes.fit,
    )


def gap(to: Settings, horizon_s: float, *, fitted: bool) -> Stage:
    calibrated = ["--perturbation", str(to.fitted)] if fitted else []
    few = ["--segments", "100", "--horizon-s", f"{horizon_s:g}"]
    folder = to.store / "gap"
    return Stage(
        "gap",
        "Can the twin be trusted?",
        "How far from the log the twin ends when it drives the logged commands.",
        ["twin", "gap", str(to.store), *calibrated, "--out", str(folder), *few],
        writes=(folder,),
        outcome=outcomes.gap,
    )


def train(to: Settings, *, twin: bool = True) -> Stage:
    """Train offline and then in the twin, or on the logs alone."""
    return Stage(
        "train",
        "Train: first on the panel, then online in the twin"
        if twin
        else "Train on the logs alone, without a twin",
        f"About {to.seconds:.0f} s of double DQN. Each condition gets its quota of every batch: "
        "half from the logs as far as its rows bear that, the rest fresh, from missions that go "
        "wrong more often. The policy chooses by Q among actions that the twin's operator finds "
        "plausible. Every row that the critic is fed is recorded.",
        [
            *("train", "--panel", str(to.panel), "--out", str(to.run)),
            *(("--seconds", f"{to.seconds:g}") if twin else ()),
            *("--device", to.device),
            *(word for setting in to.train for word in ("--set", setting)),
        ],
        writes=(to.run,),
        outcome=outcomes.train,
        shows_progress=True,
        resume=("train", "--resume", str(to.run)),
    )


def train_beside_uniform(to: Settings) -> Stage:
    """Train as `train` does, and beside it a policy that differs only in what it is fed."""
    fed = train(to)
    return replace(
        fed,
        title="Train: first on the panel, then online in the twin; beside it one fed uniformly",
        why=f"Two trainings at once, about {to.seconds:.0f} s, with the same settings and seed. "
        "In the first, each condition gets its quota of every batch, from logs and fresh rows; "
        "in the other, logs and fresh rows are drawn uniformly. Both practise the missions that go "
        "wrong more often. The policy chooses by Q among actions that the twin's operator finds "
        "plausible. Every row is recorded.",
        beside=(
            *("train", "--panel", str(to.uniform_panel), "--out", str(to.uniform)),
            *("--seconds", f"{to.seconds:g}", "--device", to.device),
            *(word for setting in to.train for word in ("--set", setting)),
        ),
        writes=(to.run, to.uniform),
        resume=(),  # one of the two may have ended
    )


def even_out(to: Settings) -> Stage:
    """Continue the run that drove less: a comparison of feeds needs equally many steps."""

    def decided() -> list[str] | None:
        from restock.train.run.run import Run

        steps = {
            path: max(Run.open(path).table("progress")["env_steps"].to_pylist(), default=0)
            for path in (to.run, to.uniform)
        }
        behind, ahead = sorted(steps, key=lambda path: steps[path])
        if steps[behind] == steps[ahead]:
            return None
        longest_s = f"{10 * to.seconds + 600:g}"  # the steps end it
        return [
            *("train", "--resume", str(behind), "--env-steps", str(steps[ahead])),
            *("--seconds", longest_s),
        ]

    return Stage(
        "even-out",
        "As many steps for both",
        "The one that has driven less continues until both have made the same number of steps.",
        ["train", "--resume", str(to.uniform), "--env-steps", "AS_THE_OTHER"],
        shows_progress=True,
        decided=decided,
    )


def train_on_logs(to: Settings) -> Stage:
    """Train the policy before fine-tuning, on the same panel and without the twin."""
    settings = ["env.twin=false", "teacher.source=logs", f"schedule.offline_updates={UPDATES}"]

    def command(settings: Sequence[str]) -> list[str]:
        return [
            *("train", "--panel", str(to.panel), "--out", str(to.logs_alone)),
            *("--device", to.device),
            *(word for setting in settings for word in ("--set", setting)),
        ]

    def decided() -> list[str]:
        from restock.replay.panel.panel import Panel
        from restock.toml import toml_value
        from restock.train.dqn.config import TeacherConfig

        drivers = set(Panel.open(to.panel).meta_column("behaviour_policy")) - {None}
        if drivers.isdisjoint(TeacherConfig().policies):  # then everybody is imitated
            return command([*settings, f"teacher.policies={toml_value(sorted(drivers))}"])
        return command(settings)

    return Stage(
        "logs-alone",
        "Before fine-tuning: a policy from the logs alone",
        f"{UPDATES:,} updates on the panel, by Q among the actions that its good drivers would"
        " plausibly take; nothing is driven in the twin.",
        command(settings),
        writes=(to.logs_alone,),
        decided=decided,
    )


def evaluate_logs_alone(to: Settings) -> Stage:
    return Stage(
        "eval-logs-alone",
        "Evaluate the policy from the logs alone",
        "On the missions that the fine-tuned one drives next.",
        [
            *("eval", str(to.run), "--episodes", str(to.episodes)),
            *("--policies", from_logs_alone(to), "--perturbations", "none"),
        ],
    )


def evaluate_beside_uniform(to: Settings) -> Stage:
    """Evaluate as `evaluate` does, beside the policy that was fed uniformly."""
    alone = evaluate(to)
    policies = f"agent,{fed_uniformly(to)},planner,random"
    return replace(
        alone,
        why="The kept checkpoint, the policy fed uniformly, the scripted planner and a random"
        " policy, clean and with less friction and more latency than in training.",
        command=[*alone.command, "--policies", policies],
    )


def film(to: Settings) -> Stage:
    return Stage(
        "film",
        "Film failures, and missions that only the fine-tuned policy completes",
        "Episodes of the evaluation, driven again: failing before on the left, and after.",
        [*("eval", str(to.run), "--episodes", "0", "--video"), *("--policies", "agent")],
    )


def from_logs_alone(to: Settings) -> str:
    """Return the name of the policy from the logs alone, as evaluations take it."""
    return f"run:{to.logs_alone}"


def fed_uniformly(to: Settings) -> str:
    """Return the name of the policy that was fed uniformly, as evaluations take it."""
    return f"run:{to.uniform}"


def evaluate(to: Settings, *, beside_logs: bool = False) -> Stage:
    """Evaluate in the twin; `beside_logs` also the way the logs were driven."""
    cloned = ["--policies", "agent,cloned,planner,random"] if beside_logs else []
    return Stage(
        "eval",
        "Evaluate on the same seeded episodes",
        "The kept checkpoint, the scripted planner and a random policy, clean and with less"
        " friction and more latency than in training.",
        ["eval", str(to.run), "--episodes", to.of_each_kind, *cloned],
        outcome=outcomes.driven,
        shows_progress=True,
    )


def evaluate_on_ways(to: Settings) -> Stage:
    """Evaluate on routes that robots really drove, on the floor of the logs."""
    return Stage(
        "ways",
        "Evaluate on the routes of the logs",
        "Start and goal of the logged episodes that the panel holds out.",
        [
            *("eval", str(to.run), "--episodes", to.of_each_kind, "--missions", "logged"),
            *("--policies", "agent,cloned,planner", "--perturbations", "none"),
        ],
        outcome=outcomes.driven_on_ways,
        shows_progress=True,
    )


def judge(to: Settings) -> Stage:
    """Evaluate off-policy, on logs that the policy did not learn from."""
    return Stage(
        "judge",
        "How good is the policy, by the logs alone, compared with their drivers?",
        "Off-policy evaluation on episodes that the panel holds out.",
        ["eval", str(to.run), "--on-logs", "own"],
        outcome=outcomes.on_logs,
        shows_progress=True,
    )


def report(to: Settings) -> Stage:
    return Stage(
        "report",
        "One page with all results",
        "What the policy was fed, what it learned, and where it fails.",
        ["report", str(to.run)],
        writes=(to.run / "report.html",),
    )
