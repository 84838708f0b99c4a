"""Prepare a run: check config, panel and twin against each other before anything is written."""

from __future__ import annotations

import math
import shutil
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from restock.arrays import F32, Bools, Ints
from restock.errors import ConfigError, PanelError, RunError
from restock.ingest.profile.profile import Profile, load_profile
from restock.ingest.task.conditions import Condition
from restock.process import expect_installed, interrupts_raised
from restock.replay.panel.logged_sampler import controller_for
from restock.replay.panel.panel import Panel
from restock.toml import read_toml
from restock.train import loop
from restock.train.dqn.config import (
    GIVEN,
    TrainConfig,
    apply_overrides,
    describe,
    load_config,
    parse_config,
)
from restock.train.dqn.learner import open_device
from restock.train.dqn.network import update_path
from restock.train.evaluation.evaluate import evaluation_time_s
from restock.train.feed.batch_record import STOPPED
from restock.train.feed.collector import FreshStrata, conditions_in_twin
from restock.train.feed.logs import Logs
from restock.train.feed.practice import check_missions, make_twin
from restock.train.feed.teacher import CheckedTeacher, Teacher, open_teacher, refuse_no_rows
from restock.train.loop import Notify, TrainResult
from restock.train.resolve import (
    check_new_run,
    planned_draws,
    resolve_config,
    resolve_teacher,
    should_mirror,
    without_twin,
)
from restock.train.run.run import (
    Run,
    RunLock,
    check_free,
    now_ns,
    panel_document,
    software_versions,
)
from restock.train.run.run_profile import (
    carries_profile,
    profile_document,
    profile_of_panel,
    profile_of_run,
    run_panel,
)
from restock.train.session import Session, open_session
from restock.train.twin.env.interface import Twin
from restock.train.twin.floors.floors import layouts_of_split, open_floors
from restock.train.twin.missions import KINDS
from restock.train.twin.physics.episode import refuse_unfit

_EVALUATION_ENVS = 16


@dataclass
class Prepared:
    """A checked run that can begin or resume; nothing is written yet."""

    path: Path
    config: TrainConfig
    profile: Profile
    panel: Panel | None
    document: dict[str, Any]  # config.json
    resumed: Run | None = None
    teacher: Any = None  # a teacher that Python code passed in
    requested: CheckedTeacher | None = None  # the teacher that a new run's config names

    def open(self) -> Session:
        """Make or reopen the run directory, and build the twin and the learner.

        Raises:
            RunError: another process trains this run, or the run cannot be resumed.
        """
        env = make_twin(self.config, self.profile, self.config.env.num_envs)
        teacher = self.requested
        if teacher is None:
            teacher = open_teacher(
                self.config.teacher, self.profile.task, seed=self.config.seed, given=self.teacher
            )
        if teacher is not None and self.resumed is None:  # fail before anything is written
            teacher.query(env, env.reset(seed=self.config.seed)[0])
        layouts = _evaluation_layouts(self.config)
        lock = RunLock(self.path)
        try:
            run = self._run()
            try:
                session = self._build(run, env, teacher, layouts)
            except BaseException:
                if self.resumed is None:  # remove the folder, as the run never began
                    shutil.rmtree(self.path, ignore_errors=True)
                raise
        except BaseException:
            lock.release()
            raise
        session.lock = lock
        return session

    def _run(self) -> Run:
        """Create the run's directory; in a resumed run's, remove what a stopped process left."""
        if self.resumed is None:
            return Run.create(self.path, self.document)
        self.resumed.remove_leftovers()
        (self.path / STOPPED).unlink(missing_ok=True)
        return self.resumed

    def _build(self, run: Run, env: Twin, teacher: CheckedTeacher | None, layouts: str) -> Session:
        profile = self.profile
        conditions, exposures = conditions_of_twin(profile)
        session = open_session(
            run,
            self.config,
            task=profile.task,
            conditions=conditions,
            exposures=exposures,
            env=env,
            evaluation_env=make_twin(
                self.config,
                self.profile,
                min(_EVALUATION_ENVS, self.config.evaluation.episodes * len(KINDS)),
                nthread=0,
                layouts=layouts,
            ),
            logs=_logs(self.panel, self.config, self.document) if self.panel is not None else None,
            teacher=teacher,
            resume=self.resumed is not None,
        )
        if self.resumed is None and self.config.env.twin and self.config.schedule.seconds:
            refuse_short_budget(session, self.config.schedule.seconds)
        return session


@interrupts_raised
def train(
    config: TrainConfig | Path | str | None = None,
    *,
    panel: Path | str | None = None,
    out: Path | str,
    settings: Sequence[str] = (),
    teacher: Teacher | Callable[[Any, F32], Ints] | None = None,
    stop: Callable[[], bool] = lambda: False,
    notify: Notify = lambda event, values: None,
) -> TrainResult:
    """Train a new run in the folder `out` to the end of its budget, as `restock train` does.

    Args:
        config: a config, the path of its TOML file, or None for the defaults.
        panel: the folder of a panel; None: online only.
        settings: overrides of the config, each as `key.path=value`.
        teacher: queried in the twin instead of the teacher that `teacher.source` names: an object
            with `act(env, observation)`, or a function like `act`, which returns actions (N,).
        stop: called between steps; True ends the run with a checkpoint.
        notify: called for every row of `progress` and every evaluation.

    Raises:
        RunError: `out` already exists.
        ConfigError: the config cannot be used, or there is no such device.
        PanelError: the panel was made for another task than the twin's, or another discount.
        TrainingInterrupted: `stop` returned True.
    """
    panel_path = None if panel is None else Path(panel)
    named = [f"teacher.source={GIVEN}"] if teacher is not None else []
    prepared = prepare_new(
        Path(out),
        panel_path,
        Path(config) if isinstance(config, str) else config,
        [*settings, *named],
    )
    prepared.teacher = teacher
    session = prepared.open()
    try:
        return loop.train(session, stop=stop, notify=notify)
    finally:
        session.close()


def prepare_new(
    out: Path,
    panel_path: Path | None,
    config: TrainConfig | Path | None,
    overrides: Sequence[str] = (),
) -> Prepared:
    """Check a new run; `config` may be the path of a TOML file, None for the defaults.

    Raises:
        RunError: `out` already exists.
        ConfigError: the config cannot be used, or there is no such device.
        PanelError: the panel has another task or discount, or its profile is not available.
        TeacherFailed: the user's teacher class raised an error when it was created.
    """
    check_free(out)
    if isinstance(config, TrainConfig):
        document = apply_overrides(msgspec.to_builtins(config), overrides)
        chosen = document["profile"] != TrainConfig().profile
        config = parse_config(document, where="TrainConfig")
    else:
        file, config = config, load_config(config, overrides)
        chosen = "profile" in apply_overrides({} if file is None else read_toml(file), overrides)
    open_device(config.device)
    expect_installed("record.trackers", *config.record.trackers)
    driven = {config.env.layouts, _evaluation_layouts(config)} if config.env.twin else ()
    for layouts in driven:
        # Evaluation drives every kind of mission that `env.conditions` names, even with share 0,
        # so each must fit on the floors.
        refuse_unfit(open_floors(layouts), config.env.conditions)
    fed = Panel.open(panel_path) if panel_path is not None else None
    if fed is not None and (not chosen or carries_profile(fed, config.profile)):
        profile = profile_of_panel(fed)
        config = msgspec.structs.replace(config, profile=profile.name)
    else:
        profile = load_profile(config.profile)
    panel = open_panel(panel_path, config, profile) if panel_path is not None else None
    if not config.env.twin:
        config = without_twin(config, panel)
    check_missions(config, profile)
    config = resolve_teacher(config, profile, panel)
    drivers = None if panel is None else sorted(rows_by_policy(panel))
    refuse_no_rows(config.teacher, drivers)
    config = resolve_config(config, panel)
    check_new_run(config, profile.task, panel)
    requested = None
    if config.teacher.source != GIVEN:  # not created again later, as it may be large
        requested = open_teacher(config.teacher, profile.task, seed=config.seed)
    written = _document(config, profile, panel)
    return Prepared(out, config, profile, panel, written, requested=requested)


def prepare_resumed(path: Path, overrides: Sequence[str] = ()) -> Prepared:
    """Check a run to resume; `overrides` may extend its budget or move it to another device.

    Raises:
        RunError: there is no such run, or its task has changed since.
        PanelError: its panel is gone, damaged or replaced by another.
    """
    run = Run.open(path)
    stored = run.document["config"]
    config = parse_config(apply_overrides(stored, overrides), where=str(path / "config.json"))
    open_device(config.device)
    expect_installed("record.trackers", *config.record.trackers)
    given = config.profile != stored.get("profile")
    profile = load_profile(config.profile) if given else profile_of_run(run)
    if profile.task.hash != run.document["task_hash"]:
        raise RunError(
            f"was trained on task {run.document['task_hash']}, profile {config.profile!r} now"
            f" defines {profile.task.hash}",
            where=str(path),
            remedy="start a new run: values of one task have no meaning in another",
        )
    if config.teacher.mirror:
        should_mirror(config.teacher, profile.task)  # raises if an action has no opposite
    panel = run_panel(run.document)  # raises if the panel is gone or was replaced
    if panel is not None:
        panel = open_panel(panel.path, config, profile)
    return Prepared(path, config, profile, panel, run.document, run)


def conditions_of_twin(profile: Profile) -> tuple[list[Condition], list[Condition]]:
    """Return the conditions and exposures of a profile that can be evaluated on fresh rows."""
    conditions, exposures = (
        conditions_in_twin(kind, profile.signals, lidar=profile.task.lidar)[0]
        for kind in (profile.conditions, profile.exposures)
    )
    return conditions, exposures


def _never_driven(names: Sequence[str], config: TrainConfig) -> Bools:
    """Return which strata (S,) are named after a kind of mission that the twin never drives."""
    env = config.env
    return np.array(
        [name in KINDS and not env.conditions.get(name) and env.missions is None for name in names]
    )


def refuse_short_budget(session: Session, seconds: float) -> None:
    """Estimate the time of an evaluation, and refuse a budget that two evaluations use up.

    Raises:
        ConfigError: the budget is too short; names one that suffices.
    """
    env, specs = session.evaluation_buffer.env, session.fixed_episodes
    one_s = evaluation_time_s(env, specs, session.task.time_limit_steps)
    if seconds < 2 * one_s:
        raise ConfigError(
            f"{seconds:g} s are too short: an evaluation of {len(specs)} episodes takes about"
            f" {one_s:.1f} s here, and there is one before driving and one at the end",
            where="schedule.seconds",
            remedy=f"give --seconds {math.ceil(4 * one_s)} or more, or evaluate fewer episodes"
            " (evaluation.episodes)",
        )
    session.progress.evaluation_s = one_s


def open_panel(path: Path, config: TrainConfig, profile: Profile) -> Panel:
    """Open a panel, check its bytes, and compare it with the twin's task and the config's discount.

    Raises:
        PanelError: the panel is damaged, or its task or discount differs; names both values.
    """
    panel = Panel.open(path, verify=True)
    if panel.task_hash != profile.task.hash:
        raise PanelError(
            f"its rows are of task {panel.task_hash}, the twin's ({profile.name}) is"
            f" {profile.task.hash}: observation, action or reward differ",
            where=str(path),
            remedy="leave out `profile` in the config to use the panel's; or ingest the logs "
            f"again with `--profile {profile.name}` and mix again",
        )
    if abs(panel.discount - config.loss.discount) > 1e-9:
        raise PanelError(
            f"its returns are discounted by {panel.discount}, loss.discount is"
            f" {config.loss.discount}",
            where=str(path),
            remedy=f"use --set loss.discount={panel.discount}, or mix with that discount",
        )
    return panel


def rows_by_policy(panel: Panel) -> Counter[str]:
    """Count rows by behaviour policy."""
    return Counter(name for name in panel.meta_column("behaviour_policy").tolist() if name)


def _evaluation_layouts(config: TrainConfig) -> str:
    return config.evaluation.layouts or layouts_of_split(config.env.layouts, "validation")


def _logs(panel: Panel, config: TrainConfig, document: dict[str, Any]) -> Logs:
    return Logs.of_panel(
        panel,
        planned_draws(config),
        as_of_ns=int(document["created_ns"]),
    )


def _document(config: TrainConfig, profile: Profile, panel: Panel | None) -> dict[str, Any]:
    fed = None
    if panel is not None:
        fresh = None
        if config.env.twin:
            conditions, exposures = conditions_of_twin(profile)
            strata = FreshStrata.of(panel, [*conditions, *exposures])
            fresh = strata.known & ~_never_driven(strata.names, config)
        planned = planned_draws(config)
        controller = controller_for(panel, planned, config.replay.logs_share, fresh)
        fed = {
            **panel_document(panel),
            # The quotas, and how far the draws of this run can fill them.
            "forecast": controller.forecast(),
            "planned_draws": asdict(planned),
        }
    # `next_value` is missing in runs of earlier Restocks, whose TD target used the target network's
    # value, and in runs of a user's own algorithm, which defines its own TD target.
    lower = config.loss.algorithm == "dqn" and config.loss.double and not config.teacher.has_filter
    return {
        "created_ns": now_ns(),
        "config": msgspec.to_builtins(config),
        **({"next_value": "lower of both networks"} if lower else {}),
        "panel": fed,
        "target": describe(config.target),
        "update_path": update_path(config.device, config.threads),
        **profile_document(profile),
        # Conditions that only logs can have, each with the signals that the twin does not fill.
        "not_evaluated": conditions_in_twin(
            profile.conditions, profile.signals, lidar=profile.task.lidar
        )[1],
        "seeds": {"run": config.seed, "evaluation": config.evaluation.seed},
        "versions": software_versions(),
    }
