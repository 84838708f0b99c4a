"""Draw, label and record the rows of Stable-Baselines3's replay buffer: logs by quota, and fresh.

The library runs the training loop. Its buffer (`restock.train.libraries.sb3_buffer`) draws rows of
the panel from this class, and passes every step and every batch to it. So the run directory gets
the same tables as that of `restock train`: `strata`, `ages`, `policies`, `sampled_episodes`,
`episodes`, `audit` and `progress`.

The twin's single environment gives the signals at t and at t + 1 in the `info` of each step, so an
episode that ended is labelled by the same conditions, over the same signals, as logs.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import torch
from numpy.typing import NDArray

from restock.arrays import F32, Ints
from restock.errors import ConfigError, MixtureError, PanelError
from restock.ingest.profile.profile import Profile, load_profile
from restock.ingest.task.conditions import NOMINAL, Condition, label, primary
from restock.ingest.task.schema import signal_arrays
from restock.ingest.task.task import STORED_SIGNALS
from restock.replay.panel.logged_sampler import BatchDraw, LoggedSampler
from restock.replay.panel.panel import Panel
from restock.replay.sampling.ring import FreshRing
from restock.replay.sampling.rules import RULES
from restock.train.dqn.algorithm import Loss
from restock.train.feed.batch_record import FeedRecord, NotFinite, check_fed, row_ids
from restock.train.feed.batches import ReplayBatch
from restock.train.feed.collector import conditions_in_twin
from restock.train.feed.fresh_labels import EpisodeLabels, values_entries
from restock.train.feed.logs import Logs
from restock.train.run.run import Rows, Run, check_free, now_ns, panel_document, software_versions
from restock.train.run.run_profile import profile_document, profile_of_panel
from restock.train.run.run_tables import TABLES

SB3 = "stable-baselines3"
PROFILE = "warehouse_amr"
_NO_ROWS: Ints = np.empty(0, np.int64)
_TAKEN_REMEDY = (
    "choose another `run`; to go on in this one, load the replay buffer that was saved with it"
    " (model.load_replay_buffer)"
)
NO_LOGS = BatchDraw(_NO_ROWS, _NO_ROWS, None, np.empty(0))


@dataclass(frozen=True)
class FeedOptions:
    """Keyword options of the buffer."""

    run: str | Path | None = None  # the run directory to make; None: no record is kept
    logs_share: float | None = None  # logged rows' share of a batch; None: the mixture's
    # Profile of the environment; None: that of the panel, or warehouse_amr without a panel.
    profile: str | None = None
    seed: int = 0  # seed of the draws, and of the choice of batches to audit
    audit_share: float = 0.01  # share of batches whose rows are all recorded
    log_every: int = 500  # batches per logging interval
    # Other settings to record in the run, by the keys of `restock train`: target, loss, …
    settings: Mapping[str, Any] = field(default_factory=dict)


class MixedFeed:
    """A source of batches: rows of a panel and of a ring of fresh rows, by the panel's mixture.

    Args:
        capacity, num_envs, observation_size, n_step: arguments of `ring`, a `FreshRing`.
        discount: discount of the ring's rows; None: the panel's, or .99 without a panel.
        panel: None for fresh rows alone.

    A panel made from a table of any task has no profile. The environment then names the condition
    of each step in `info["condition"]`.

    Raises:
        ConfigError: `logs_share` is outside [0, 1].
        PanelError: the panel's task is not the environment's.
        RunError: something is at `run` already.
    """

    def __init__(
        self,
        capacity: int,
        num_envs: int,
        observation_size: int,
        panel: Panel | None,
        options: FeedOptions,
        *,
        n_step: int = 1,
        discount: float | None = None,
    ) -> None:
        self.panel, self.options = panel, options
        share = options.logs_share
        if share is not None and not 0 <= share <= 1:
            raise ConfigError(f"logs_share must be in [0, 1], got {share:g}")
        profile = environment_profile(options.profile, panel)
        if panel is not None:
            _check_panel(panel, profile, observation_size)
        self.logs = Logs.of_panel(panel, as_of_ns=now_ns()) if panel is not None else None
        self.rng = np.random.default_rng([options.seed, 1])
        self.labels = make_labeller(profile, panel, num_envs)
        self.env_steps = self.batches = self.invalid_steps = 0
        self.episode_labels = EpisodeLabels()
        self._sampler: LoggedSampler | None = None
        self._td_missing = False  # whether the last batch came without TD errors
        self._phase = "offline"
        self._open = 0  # batches in the open logging interval
        self._episodes: dict[int, dict[str, Any]] = {}
        self._begun = time.monotonic()
        if discount is None:
            discount = panel.discount if panel is not None else 0.99
        self.ring = FreshRing(
            capacity,
            num_envs,
            observation_size,
            discount=discount,
            n_step=n_step,
            conditions=self.labels.names,
            behaviour_policies=(SB3,),
        )
        self.run: Run | None = None
        self.record: FeedRecord | None = None
        if options.run is not None:
            self.run = _create_run(Path(options.run), profile, panel, num_envs, options)
            tables: Any = PartialTables(self.run)
            self.record = FeedRecord(
                tables,
                self.logs,
                self.ring,
                audit_share=options.audit_share,
                seed=options.seed,
                actions=profile.task.action_names if profile is not None else None,
                labels=self.episode_labels,
            )

    def take(self, envs: Ints, keys: Ints, ended: NDArray[Any], infos: Sequence[Any]) -> None:
        """Add one step of `envs` (n,) in episodes `keys` (n,), and label episodes that ended."""
        self.env_steps += len(envs)
        for env, key, over, info in zip(
            envs.tolist(), keys.tolist(), np.asarray(ended).tolist(), infos, strict=True
        ):
            if not self.labels.step(env, info, ended=bool(over), key=key):
                self.episode_labels.give_up(key)
            if over and self.run is not None:
                self._episodes[key] = episode_row(env, key, info) | {
                    "env_steps": self.env_steps,
                    "gradient_steps": self.batches,
                }
        self.label()

    def label(self, *, all_of_them: bool = False) -> None:
        """Label the episodes that ended."""
        for labelled in self.labels.label(all_of_them=all_of_them):
            self.ring.set_labels(labelled.key, labelled.codes)
            self.episode_labels.note(labelled.key, labelled.codes)
            if labelled.key in self._episodes:
                self._episodes[labelled.key]["conditions"] = labelled.conditions

    def draw_logs(self, batch_size: int) -> BatchDraw:
        """Draw a batch's logged rows (L,) by the mixture: the whole batch while the ring is empty.

        Raises:
            MixtureError: the ring is empty and the panel's rows have reached their limit of draws;
                or the draws depend on TD errors, and the last batch came without them.
        """
        if self.logs is None:
            return NO_LOGS
        if self._td_missing:
            others = ", ".join(name for name, rule in RULES.items() if not rule.follows_td)
            raise MixtureError(
                "the mixture's draws depend on TD errors, and this buffer gets none",
                remedy="set `critic`, e.g. to dqn_critic(model); or mix with a `within` of"
                f" {others}",
            )
        if self._sampler is None:
            self._sampler = self.logs.sampler(
                batch_size, self.options.logs_share, self.options.seed
            )
        count = batch_size
        if len(self.ring):
            self._sampler.move_to(self.env_steps)
            count = round(batch_size * self._sampler.controller.logs_share)
        drawing = self._sampler.draw(count) if count else NO_LOGS
        if not len(self.ring) and len(drawing.rows) < batch_size:
            raise MixtureError(
                f"every row of the panel was drawn {self._sampler.controller.max_replays} times",
                remedy="collect steps, or mix with more draws per row",
            )
        return drawing

    def draw_fresh(self, count: int) -> Ints:
        """Draw `count` slots of the ring uniformly, of rows not older than the mixture allows.

        Raises:
            MixtureError: the ring has no row, or only rows above that age.
        """
        if not count:
            return _NO_ROWS
        slots = np.arange(len(self.ring))
        most = self.panel.header.mixture.max_age_env_steps if self.panel is not None else None
        if most is not None:
            slots = slots[self.ring.meta["env_step"][slots] >= self.env_steps - most]
        if not len(slots):
            raise MixtureError(
                "there is no fresh row to draw" + (f" younger than {most} steps" if most else ""),
                remedy="collect steps before learning",
            )
        return slots[self.rng.integers(len(slots), size=count)]

    def drawn(
        self,
        packed: F32,
        drawing: BatchDraw,
        slots: Ints,
        *,
        td: F32 | None = None,
        q: F32 | None = None,
    ) -> None:
        """Record the batch of one update: packed rows (B, W), logged rows first.

        `td` (B,), Q minus target, and `q` (B,) are null in the tables if they are None. If `td` is
        given, it also updates the priorities.

        Raises:
            NotFinite: a row or a TD error is NaN or infinite; names the rows.
        """
        path = None if self.run is None else self.run.path
        steps = {"env_steps": self.env_steps, "gradient_steps": self.batches}
        try:
            check_fed(packed, td, lambda: self._row_ids(drawing, slots), run=path, steps=steps)
        except NotFinite:
            self.flush()  # so that the tables have all batches up to this one
            raise
        if self._sampler is not None and self._sampler.needs_td and len(drawing.rows):
            self._td_missing = td is None
            if td is not None:
                td_abs = np.abs(td[: len(drawing.rows)])
                self._sampler.update(drawing.rows, td_abs)
        phase = "online" if len(slots) else "offline"
        if phase != self._phase:
            self._close_interval()  # because an interval has only one phase
            self._phase = phase
        self.batches += 1
        if self.record is None:
            return
        unknown = np.full(len(packed), np.nan, np.float32)
        batch = ReplayBatch(
            lambda: torch.from_numpy(packed),
            weight=None,
            log_rows=drawing.rows,
            log_stratum=drawing.strata,
            slots=slots,
            quota=drawing.quota,
        )
        loss = Loss(
            value=torch.zeros(()),
            td=torch.from_numpy(unknown if td is None else td),
            q=torch.from_numpy(unknown if q is None else q),
        )
        self.record.batch(self.batches, self.env_steps, batch, loss, last_sync=None)
        self._open += 1
        if self._open >= self.options.log_every:
            self._close_interval()

    def evaluated(self, episodes: Rows = (), steps: Rows = ()) -> None:
        """Record an evaluation: rows of the run's tables `evaluations` and `evaluation_buffer`.

        `compare` needs condition, episode_seed, success and return in `episodes`. `diagnose` needs
        condition, rows, td_abs_mean, td_online_abs_mean and q_lag in `steps`, per condition.
        """
        if self.run is None:
            return
        self._close_interval()
        now = {"env_steps": self.env_steps, "gradient_steps": self.batches}
        usual = {**now, "perturbation": "none", "block": "none"}
        tables = PartialTables(self.run)
        tables.append("evaluations", [{**usual, **row} for row in episodes])
        tables.append("evaluation_buffer", [{**now, **row} for row in steps])
        self.run.flush()

    def _row_ids(self, drawing: BatchDraw, slots: Ints) -> list[dict[str, Any]]:
        meta = self.ring.meta
        return row_ids(self.logs, drawing.rows, meta["episode"][slots], meta["episode_step"][slots])

    def flush(self) -> None:
        """Write all rows to the run's files; rows of running episodes get no conditions."""
        self._close_interval()
        if self.record is not None and self.run is not None:
            self.record.write_held()
            self.run.flush()

    def _close_interval(self) -> None:
        if self.record is None or self.run is None:
            return
        self.label(all_of_them=True)
        means = self.record.flush(self.env_steps, self.batches, self._phase)
        if self._open:
            row = {
                "env_steps": self.env_steps,
                "gradient_steps": self.batches,
                "wall_s": time.monotonic() - self._begun,
                "phase": self._phase,
                "updates": self._open,
                "ring_rows": len(self.ring),
                "episodes": len(self._episodes),
                **means,
            }
            PartialTables(self.run).append("progress", [row])
        PartialTables(self.run).append("episodes", list(self._episodes.values()))
        self._open, self._episodes = 0, {}
        self.run.flush()

    def begin_episodes(self) -> None:
        """Give up the running episodes: none of them will get another step or labels."""
        self.labels.forget()
        for key in self.ring.begin_episodes().tolist():
            self.episode_labels.give_up(key)

    def __getstate__(self) -> dict[str, Any]:
        """Save the elapsed time instead of the start time: another process has another clock."""
        return vars(self) | {"_begun": time.monotonic() - self._begun}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._begun = time.monotonic() - self._begun


def environment_profile(name: str | None, panel: Panel | None) -> Profile | None:
    """Return the profile `name`; if that is None, the panel's, or without one warehouse_amr.

    Return None if the panel was made from a table of any task, which has no profile.
    """
    if name is None and panel is not None:
        return None if panel.task_hash.startswith("table-") else profile_of_panel(panel)
    return load_profile(name or PROFILE)


def make_labeller(profile: Profile | None, panel: Panel | None, num_envs: int) -> FreshLabels:
    """Make a labeller that uses the profile's conditions, or without a profile those in infos."""
    if profile is None:
        names = panel.header.conditions if panel is not None else [NOMINAL]
        return FreshLabels(None, num_envs, names)
    signals, lidar = profile.signals, profile.task.lidar
    return FreshLabels(conditions_in_twin(profile.conditions, signals, lidar=lidar)[0], num_envs)


def _check_panel(panel: Panel, profile: Profile | None, observation_size: int) -> None:
    if profile is None:
        if panel.observation_size != observation_size:
            raise PanelError(
                f"its observations have {panel.observation_size} entries, the environment's have"
                f" {observation_size}",
                where=str(panel.path),
                remedy="log and train with the same wrappers around the environment",
            )
        return
    task_hash = profile.task.hash
    if panel.task_hash != task_hash or panel.observation_size != observation_size:
        raise PanelError(
            f"its rows are of task {panel.task_hash} ({panel.observation_size} entries per "
            f"observation), the environment's ({profile.name}) is {task_hash}"
            f" ({observation_size})",
            where=str(panel.path),
            remedy=f"ingest the logs with `--profile {profile.name}` and mix again",
        )


# Columns of `episodes` that are copied from the info of an episode's last step.
_INFO_COLUMNS = ("episode_seed", "perturbation", "block", "success", "bumps")


def _create_run(
    path: Path,
    profile: Profile | None,
    panel: Panel | None,
    num_envs: int,
    options: FeedOptions,
) -> Run:
    """Make the run and write its `config.json`; raise RunError if something is at `path`."""
    check_free(path, _TAKEN_REMEDY)
    mixed = None
    if panel is not None:
        strata = {stratum.name: stratum.share for stratum in panel.strata}
        mixed = {**panel_document(panel), "strata": strata}
    if profile is not None:
        signals, lidar = profile.signals, profile.task.lidar
        about = profile_document(profile) | {
            "not_evaluated": conditions_in_twin(profile.conditions, signals, lidar=lidar)[1]
        }
    else:  # the panel was made from a table of any task
        task_hash = None if panel is None else panel.task_hash
        about = {"task_hash": task_hash, "actions": [], "labels_version": None}
    return Run.create(
        path,
        {
            "created_ns": now_ns(),
            "library": {"version": version(SB3), "name": SB3},
            "config": {
                "logs_share": options.logs_share,
                "seed": options.seed,
                "audit_share": options.audit_share,
                "num_envs": num_envs,
                **options.settings,
            },
            "panel": mixed,
            **about,
            "seeds": {"run": options.seed},
            "versions": software_versions() | {SB3: version(SB3)},
        },
    )


class PartialTables:
    """A writer to a run's tables that writes missing values and NaN as null."""

    def __init__(self, run: Run) -> None:
        self.run = run

    def append(self, table: str, rows: Sequence[Mapping[str, Any]]) -> None:
        blank = dict.fromkeys(TABLES[table].names)
        self.run.append(table, [blank | {k: known(v) for k, v in row.items()} for row in rows])

    def append_columns(self, table: str, columns: Mapping[str, Any]) -> None:
        self.run.append_columns(table, {k: column(v) for k, v in columns.items()})


def column(values: Any) -> Any:
    """Return a column, or one value for all rows, with None for NaN."""
    if isinstance(values, np.ndarray) and values.dtype.kind == "f" and np.isnan(values).any():
        values = values.tolist()
    return [known(value) for value in values] if isinstance(values, list) else known(values)


def known(value: Any) -> Any:
    """Return a value, or None for NaN."""
    return None if isinstance(value, float) and value != value else value


def episode_row(env: int, key: int, info: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row of `episodes`, with the columns that the last step's info has."""
    columns = set(TABLES["episodes"].names)
    row = {"env": env, "episode": key, "conditions": []}
    row |= {name: _plain_value(info[name]) for name in _INFO_COLUMNS if name in info}
    if "episode_condition" in info:
        row["true_condition"] = _plain_value(info["episode_condition"])
    if "perturbation_values" in info:
        row["perturbation_values"] = values_entries(str(_plain_value(info["perturbation_values"])))
    if "episode_steps" in info:
        row["steps"] = _plain_value(info["episode_steps"])
    return {name: value for name, value in row.items() if name in columns}


def _plain_value(value: Any) -> Any:
    return value.item() if hasattr(value, "item") else value


EPISODES_PER_QUERY = 8  # ended episodes labelled at once, or num_envs if that is less
_COMMANDS = ("command_speed_mps", "command_yaw_rate_radps")
_SIGNAL_NAMES = tuple(signal.name for signal in STORED_SIGNALS)


@dataclass(frozen=True)
class Labelled:
    """The labels of an episode."""

    key: int
    codes: Ints  # (T,) code of each step's condition; the last code is nominal
    conditions: list[str]  # conditions that held at some step


class FreshLabels:
    """A labeller that finds the conditions of N environments' episodes from their steps' infos.

    Args:
        conditions: evaluated on the infos' signals; None: each info names its step's `condition`.
        names: the conditions that infos may name.

    An episode gets no labels if the info of a step lacks signals, or names no known condition.
    """

    def __init__(
        self, conditions: Sequence[Condition] | None, num_envs: int, names: Sequence[str] = ()
    ) -> None:
        self.conditions: list[Condition] | None = None
        self.names = tuple(names)
        self._enough = 1  # ended episodes to wait for before labelling them
        if conditions is not None:
            self.conditions = sorted(conditions, key=lambda c: (c.priority, c.name))
            self.names = (*(condition.name for condition in self.conditions), NOMINAL)
            self._enough = min(EPISODES_PER_QUERY, num_envs)
        self._running: list[list[Any]] = [[] for _ in range(num_envs)]
        self._ended: list[tuple[int, list[Any]]] = []  # key; signals or condition per step

    def step(self, env: int, info: Mapping[str, Any], *, ended: bool, key: int) -> bool:
        """Add one environment's step; `key` names its episode.

        Returns False if the episode has ended and cannot be labelled, else True.
        """
        steps = self._running[env]
        steps.append(self._step_facts(info))
        if not ended:
            return True
        self._running[env] = []
        if any(step is None for step in steps):
            return False
        if self.conditions is not None:
            steps.append({name: info["signals"][name] for name in _SIGNAL_NAMES})
        self._ended.append((key, steps))
        return True

    def _step_facts(self, info: Mapping[str, Any]) -> Any:
        """Return a step's signals and command, or the condition that it names; None if unknown."""
        if self.conditions is None:
            name = info.get("condition")
            return name if name in self.names else None
        before, after = info.get("signals_before"), info.get("signals")
        if before is None or after is None:
            return None
        row = {name: before[name] for name in _SIGNAL_NAMES}
        return row | {name: after[name] for name in _COMMANDS}

    def forget(self) -> None:
        """Forget the running episodes: they stay unlabelled."""
        self._running = [[] for _ in self._running]

    def label(self, *, all_of_them: bool = False) -> list[Labelled]:
        """Label the ended episodes once enough wait for a query; return their labels."""
        waiting = self._ended
        if not waiting or (len(waiting) < self._enough and not all_of_them):
            return []
        self._ended = []
        if self.conditions is None:
            return [
                Labelled(
                    key,
                    np.array([self.names.index(name) for name in steps], np.int64),
                    sorted(set(steps) - {NOMINAL}),
                )
                for key, steps in waiting
            ]
        return self._by_conditions(waiting, self.conditions)

    def _by_conditions(
        self, waiting: Sequence[tuple[int, list[Any]]], conditions: Sequence[Condition]
    ) -> list[Labelled]:
        rows = [row for _, steps in waiting for row in steps]
        lengths = [len(steps) for _, steps in waiting]
        columns: dict[str, Any] = {
            "episode_index": np.repeat(np.arange(len(lengths)), lengths),
            "step_index": np.concatenate([np.arange(length) for length in lengths]),
        }
        signals = {
            signal.name: np.array([row[signal.name] for row in rows], signal.dtype)
            for signal in STORED_SIGNALS
        }
        columns |= signal_arrays(signals)
        held = label(pa.table(columns), conditions)
        place = {name: code for code, name in enumerate(self.names)}
        codes = np.array([place[n] for n in primary(held, conditions)], np.int64)
        if not conditions:
            codes = np.zeros(len(rows), np.int64)
        labelled, begin = [], 0
        for (key, _), length in zip(waiting, lengths, strict=True):
            inside = slice(begin, begin + length - 1)  # the last step begins no transition
            begin += length
            names = [name for name, steps in held.items() if steps[inside].any()]
            labelled.append(Labelled(key, codes[inside], names))
        return labelled
