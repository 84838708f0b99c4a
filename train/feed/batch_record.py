"""Record what the critic was fed: exact sums over all batches, and all rows of a seeded sample.

A batch's rows, strata, TD errors and values are kept as they are sampled (no statistics inside the
update loop) and summed once per interval. The sums go to the run's tables `fed`, `strata`,
`conditions`, `actions`, `ages`, `sampled_episodes` and `policies`; the rows of audited batches to
`audit`. Fresh rows are written once their episodes have ended, when their conditions are known.

Numbers that are not finite end a run with an error that names the rows of the batch: a loss or
gradient that is NaN or infinite makes every value NaN within an update. `restock.train.loop` checks
the loss of every update, which costs nothing because it is summed anyway. A gradient that is not
finite under a finite loss shows in the parameters: they are checked before an interval is closed, a
policy is evaluated and a checkpoint is written. In the training loop of another library, the rows
and TD errors of its replay buffer are checked.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, NoReturn

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from restock import native
from restock.arrays import F32, Bools, Ints
from restock.errors import RunError
from restock.files import write_text
from restock.replay.mixture.share_controller import ShareController
from restock.replay.sampling.ring import FreshRing
from restock.state import Stateful
from restock.train.dqn.algorithm import Loss
from restock.train.feed import sampled_rows
from restock.train.feed.batches import ReplayBatch
from restock.train.feed.fresh_labels import WAITING, EpisodeLabels, FreshPerturbations
from restock.train.feed.logs import Logs
from restock.train.feed.sampled_rows import (
    FRESH,
    GREEDY,
    LOGGED,
    BatchValues,
    Columns,
    GreedyRows,
    HeldInterval,
    SampledRows,
    SourceRows,
    add_names,
    fresh_audit,
    keep_rows,
    logged_audit,
    row_hashes,
)
from restock.train.run.run import Run

UNLABELLED = "unlabelled"
_NS_PER_DAY = 86_400e9
# Most fresh rows held back for labels; if there are more, the oldest interval is written as it is.
_MAX_HELD = 1 << 21
_MEANS = ("td_abs_mean", "q_mean", "q_abs_max", "reward_mean", "logs_share")


class FeedRecord(Stateful):
    """The record of a run's batches.

    Args:
        audit_share: share of batches that are audited, chosen by `seed`.
        actions: names of the task's actions; None: the table `actions` gets no rows.
        greedy: returns the policy's action (B,) for observations (B, D) of audited batches.
        labels: labels of the ring's ended episodes; None: rows are neither labelled nor held back.
        perturbations: the perturbations in force in the ring's episodes; None: not known.
        quotas: the controller of a batch's shares; None: no quotas, and `fed` gets no rows.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        "_rng",
        "_total",
        "_logged",
        "_fresh",
        "_greedy",
        "_audits",
        "_held",
        "_quota",
        "_quota_batches",
        "_wanted",
        "_batches",
    )

    def __init__(
        self,
        run: Run,
        logs: Logs | None,
        ring: FreshRing,
        *,
        audit_share: float,
        seed: int,
        actions: Sequence[str] | None = None,
        greedy: Callable[[F32], Ints] | None = None,
        labels: EpisodeLabels | None = None,
        perturbations: FreshPerturbations | None = None,
        quotas: ShareController | None = None,
    ) -> None:
        self.quotas = quotas
        self.run, self.logs, self.ring = run, logs, ring
        self.actions, self.greedy = actions, greedy
        self.labels, self.perturbations = labels, perturbations
        self.audit_share = audit_share
        self._by_native = native.IS_USED
        self._rng = np.random.default_rng([seed, 4])
        self._age_days = (
            np.maximum(logs.as_of_ns - logs.stamp_ns, 0) / _NS_PER_DAY if logs is not None else None
        )
        # Rows drawn since the run began, by stratum (S,), for each source.
        sizes = {"logs": 0 if logs is None else len(logs.strata), "fresh": len(ring.strata) + 1}
        self._total = {name: np.zeros(size, np.int64) for name, size in sizes.items()}
        self._logged, self._fresh = SampledRows(LOGGED), SampledRows(FRESH)
        # Audited rows of the open interval: greedy actions in logged rows, columns of fresh rows.
        self._greedy = SampledRows(GREEDY)
        self._audits: list[dict[str, Any]] = []
        self._held: list[HeldInterval] = []  # closed intervals, the oldest first
        # Each stratum's share of the logged rows (S,), summed over the open interval's batches.
        self._quota = np.zeros(sizes["logs"])
        self._quota_batches = 0
        # Each stratum's quota of the whole batch (S,), summed over the open interval's batches.
        self._wanted = np.zeros(0 if quotas is None else len(quotas.wanted))
        self._batches = 0
        # The last two batches' rows: row in the panel; for fresh rows, episode key and step.
        none: NDArray[np.int64] = np.empty(0, np.int64)
        self._last: tuple[NDArray[np.int64], ...] = (none, none, none)
        self._before: tuple[NDArray[np.int64], ...] = self._last

    def batch(
        self,
        step: int,
        env_steps: int,
        batch: ReplayBatch,
        loss: Loss,
        last_sync: int | None,
        *,
        tail: Tensor | None = None,
    ) -> None:
        """Keep the batch of gradient step `step` (from 1), and audit it if it is in the sample.

        This runs inside the update loop, so it keeps only what is lost by the interval's end.
        `last_sync` is the update after which the target last moved; None if unknown. `tail` (B, 3)
        is the rows' action, reward and discount; None: they are read from the batch.
        """
        last = batch.rows if tail is None else tail
        values = BatchValues(
            loss.td.cpu().numpy(),
            loss.q.cpu().numpy(),
            None if batch.weight is None else batch.weight.cpu().numpy(),
            last.cpu().numpy()[:, -3:],
        )
        keep_rows(
            values,
            batch.log_rows,
            batch.log_stratum,
            batch.slots,
            self.ring,
            (env_steps, step),
            self._logged,
            self._fresh,
            by_native=self._by_native,
        )
        if batch.logged:
            self._quota += batch.quota
            self._quota_batches += 1
        if self.quotas is not None:
            self._wanted += batch.wanted
            self._batches += 1
        self._before = self._last
        self._last = batch.log_rows, *self._fresh.last_of("episode", "episode_step")
        if self._rng.random() < self.audit_share:
            self._audit(step, batch, last_sync)

    def last_batch(self, *, before: bool = False) -> list[dict[str, Any]]:
        """Return the ids of the rows of the last batch, or of the one before it, in order."""
        return row_ids(self.logs, *(self._before if before else self._last))

    def flush(self, env_steps: int, gradient_steps: int, phase: str) -> dict[str, float | None]:
        """Close an interval, write the rows with known labels, and return means for `progress`."""
        clocks = {"env_steps": env_steps, "gradient_steps": gradient_steps}
        logged, fresh = self._logged.columns, self._fresh.columns
        drawn = len(self._logged) + len(self._fresh)
        means: dict[str, float | None] = dict.fromkeys(_MEANS)
        if drawn:
            sums = {
                name: sum(float(func(rows[name]).sum(dtype=np.float64)) for rows in (logged, fresh))
                for name, func in (("td", np.abs), ("q", np.asarray), ("reward", np.asarray))
            }
            most = (np.abs(rows["q"]).max(initial=0.0) for rows in (logged, fresh))
            means = {
                "td_abs_mean": sums["td"] / drawn,
                "q_mean": sums["q"] / drawn,
                "q_abs_max": float(max(most)),
                "reward_mean": sums["reward"] / drawn,
                "logs_share": len(self._logged) / drawn,
            }
        if self.logs is not None and len(self._logged):
            self._write(self._logged_source(self.logs), clocks, phase)
        if drawn:
            self._held.append(self._held_interval(clocks, phase))
        self._release()
        for rows in (self._logged, self._fresh, self._greedy):
            rows.clear()
        self._audits = []
        self._quota[:], self._quota_batches = 0.0, 0
        self._wanted[:], self._batches = 0.0, 0
        return means

    def write_held(self) -> None:
        """Write the held intervals, whether all their rows are labelled or not."""
        for interval in self._held:
            self._write_fresh(interval)
        self._held = []

    def restored(self) -> None:
        """Rebuild the held intervals from a checkpoint's values."""
        held: Sequence[Any] = self._held
        self._held = [HeldInterval(**interval) for interval in held]

    def _held_interval(self, clocks: dict[str, int], phase: str) -> HeldInterval:
        """Return the open interval's fresh rows, audits and quotas, to hold until labelled."""
        ring, filled = self.ring, len(self.ring)
        waiting = ring.by_condition.stratum[:filled] == WAITING
        available = self._count_by_stratum(ring.stratum[:filled][~waiting])
        open_rows = {}
        if self.labels is None:
            available[-1] += waiting.sum()
        else:
            slots = np.flatnonzero(waiting)
            open_rows = {name: ring.meta[name][slots] for name in ("episode", "episode_step")}
            for name in ("condition", "stratum"):
                open_rows[name] = np.full(len(slots), WAITING, np.int16)
        rows = dict(self._fresh.columns)
        quotas = self._interval_quotas()
        return HeldInterval(clocks, phase, rows, available, open_rows, self._audits, quotas)

    def _count_by_stratum(self, stratum: NDArray[Any]) -> Ints:
        """Count fresh rows (n,) by stratum (S + 1,); the last counts rows in no stratum."""
        size = len(self.ring.strata)
        return np.bincount(_with_unlabelled(stratum, size), minlength=size + 1)

    def _interval_quotas(self) -> dict[str, NDArray[Any]] | None:
        """Return the open interval's `quotas` for `sampled_rows.fed`; None without quotas."""
        quotas = self.quotas
        if quotas is None or not self._batches:
            return None
        size = len(quotas.wanted)
        drawn = np.bincount(self._logged.columns["stratum"] % size, minlength=size)
        return {
            "wanted": self._wanted / self._batches,
            "natural": quotas.natural,
            "logged": drawn,
            "reason": np.array([quotas.why_short(i) for i in range(size)]),
        }

    def _release(self) -> None:
        """Write, in order, the intervals whose rows all have their conditions."""
        if self.labels is None:
            self.write_held()
            return
        for interval in self._held:
            interval.fill(self.labels)
        self.labels.clear()
        rows = sum(len(interval.rows["td"]) for interval in self._held)
        while self._held and (rows > _MAX_HELD or not self._held[0].waits):
            interval = self._held.pop(0)
            rows -= len(interval.rows["td"])
            self._write_fresh(interval)

    def _write_fresh(self, interval: HeldInterval) -> None:
        if len(interval.rows["td"]):
            self._write(self._fresh_source(interval), interval.clocks, interval.phase)
        for audit in interval.audits:
            columns = add_names(audit, self.ring.conditions, self.ring.strata, UNLABELLED)
            self.run.append_columns("audit", columns)
        if interval.quotas is not None and self.quotas is not None:
            steps = {**interval.clocks, "phase": interval.phase}
            fresh = self._count_by_stratum(interval.rows["stratum"])
            columns = sampled_rows.fed(
                self.quotas.names[: len(fresh) - 1], interval.quotas, fresh, interval.available
            )
            self.run.append_columns("fed", {**steps, **columns})

    def _write(self, source: SourceRows, clocks: Mapping[str, int], phase: str) -> None:
        total = self._total[source.name]
        total += np.bincount(source.stratum, minlength=len(total))
        of_phase = {**clocks, "phase": phase}
        tables: dict[str, tuple[Mapping[str, Any], Columns]] = {
            "strata": (of_phase, sampled_rows.strata(source, total.copy())),
            "conditions": (of_phase, sampled_rows.conditions(source)),
            "sampled_episodes": (clocks, sampled_rows.sampled_episodes(source)),
            "policies": (clocks, sampled_rows.policies(source)),
        }
        if self.actions is not None:
            rows = sampled_rows.actions(source, self.actions)
            tables["actions"] = of_phase, rows
        for name, (steps, columns) in tables.items():
            self.run.append_columns(name, {**steps, **columns})
        for unit, age in source.ages.items():
            columns = {"source": source.name, **sampled_rows.ages(unit, age)}
            self.run.append_columns("ages", {**clocks, **columns})

    def _logged_source(self, logs: Logs) -> SourceRows:
        rows, greedy = self._logged.columns, self._greedy.columns
        row = rows["row"]
        return SourceRows(
            name="logs",
            rows=rows,
            stratum=rows["stratum"],
            strata=logs.strata,
            row=row,
            available=np.array([len(members) for members in logs.stratum_rows]),
            timings=logs.timings,
            quota=(self._quota / self._quota_batches).tolist(),
            condition=logs.condition.codes[row],
            conditions=logs.condition.names,
            episode=logs.episode.codes[row],
            episodes=logs.episode.names,
            policy=logs.behaviour_policy.codes[row],
            policies=logs.behaviour_policy.names,
            ages={} if self._age_days is None else {"days": self._age_days[row]},
            greedy=None
            if self.greedy is None
            else GreedyRows(
                greedy["stratum"], logs.condition.codes[greedy["row"]], greedy["action"]
            ),
        )

    def _fresh_source(self, interval: HeldInterval) -> SourceRows:
        ring, rows = self.ring, interval.rows
        conditions = [*ring.conditions, UNLABELLED]
        strata = [*ring.strata, UNLABELLED]
        if interval.open_rows:
            interval.available[:] += self._count_by_stratum(interval.open_rows["stratum"])
            interval.open_rows.clear()

        def audited(name: str, kinds: int) -> Ints:
            found = [_with_unlabelled(audit[name], kinds) for audit in interval.audits]
            return np.concatenate([np.empty(0, np.int64), *found])

        wanted = [audit["greedy_action"] for audit in interval.audits]
        return SourceRows(
            name="fresh",
            rows=rows,
            stratum=_with_unlabelled(rows["stratum"], len(ring.strata)),
            strata=strata,
            row=rows["episode"] * (int(rows["episode_step"].max(initial=0)) + 1)
            + rows["episode_step"],
            available=interval.available,
            timings=[None] * len(strata),
            quota=[None] * len(strata),
            condition=_with_unlabelled(rows["condition"], len(ring.conditions)),
            conditions=conditions,
            episode=rows["episode"],
            episodes=None,
            policy=rows["policy"],
            policies=ring.behaviour_policies,
            ages={
                unit: rows[f"age_{unit}"].astype(np.float64)
                for unit in ("env_steps", "gradient_steps")
            },
            greedy=None
            if self.greedy is None
            else GreedyRows(
                audited("of_stratum", len(ring.strata)),
                audited("condition", len(ring.conditions)),
                np.concatenate([np.empty(0, np.int64), *wanted]),
            ),
        )

    def _audit(self, step: int, batch: ReplayBatch, last_sync: int | None) -> None:
        """Audit every row of the last kept batch: write logged ones, hold fresh ones."""
        packed, logged = batch.rows.cpu().numpy(), batch.logged
        hashes, place = row_hashes(packed), np.arange(len(packed))
        greedy = None
        if self.greedy is not None:
            observations = packed[:, self.ring.columns["observation"]]
            greedy = self.greedy(observations)

        def whole(part: slice, columns: Columns) -> Columns:
            return {
                "gradient_step": step,
                "batch_row": place[part],
                **columns,
                "greedy_action": None if greedy is None else greedy[part],
                "last_target_sync": last_sync,
                "row_hash": hashes[part],
            }

        if logged and self.logs is not None and self._age_days is not None:
            rows = logged_audit(self._logged.last, self.logs, self._age_days, step)
            self.run.append_columns("audit", whole(slice(logged), rows))
            if greedy is not None:
                self._greedy.append(batch.log_rows, batch.log_stratum, greedy[:logged])
        if len(batch.slots):
            rows = fresh_audit(self._fresh.last, batch.slots, self.ring, self.perturbations)
            self._audits.append(whole(slice(logged, len(packed)), rows))


def _with_unlabelled(code: NDArray[Any], kinds: int) -> Ints:
    """Return codes (n,) with negative ones, which have no name, replaced by the code `kinds`."""
    return np.where(code < 0, kinds, code).astype(np.int64)


def row_ids(
    logs: Logs | None, panel_row: Ints, episode: Ints, episode_step: Ints
) -> list[dict[str, Any]]:
    """Return the ids of a batch's rows: logged ones (L,), then fresh ones (F,)."""
    known = [] if logs is None else logs.transition_id[panel_row].tolist()
    logged = zip(panel_row.tolist(), known, strict=True)
    fresh = zip(episode.tolist(), episode_step.tolist(), strict=True)
    return [
        *({"source": "logs", "panel_row": row, "transition_id": key} for row, key in logged),
        *({"source": "fresh", "episode": key, "episode_step": step} for key, step in fresh),
    ]


STOPPED = "not_finite.json"  # file in the run's directory with the rows of the batch
_NAMED = 8  # most rows that the message names; the file has all of them
LEAVE_OUT = (
    "`restock trace PANEL PANEL_ROW` shows where such a row comes from; exclude it with the "
    "mixture's `where`, mix again and train again"
)
TRAIN_SLOWER = (
    "train with a lower optimizer.learning_rate; checkpoints and tables up to here are valid"
)


class NotFinite(RunError):
    """A loss, gradient or parameter was NaN or infinite."""


def check_fed(
    packed: F32,
    td: F32 | None,
    rows: Callable[[], list[dict[str, Any]]],
    *,
    run: Path | None,
    steps: Mapping[str, int],
) -> None:
    """Check a batch (B, W) of another library's loop, and its TD errors (B,) if they are known.

    Args:
        rows: returns the ids of the batch's rows, as `FeedRecord.last_batch` does.
        run: the run's directory, if there is one.
        steps: `env_steps` and `gradient_steps` so far.

    Raises:
        NotFinite: a row or a TD error is not finite; names the rows.
    """
    bad_rows: Bools = np.logical_not(np.isfinite(packed).all(axis=1))
    bad_td: Bools = np.zeros(len(packed), np.bool_)
    if td is not None:
        bad_td = np.logical_not(np.isfinite(td))
    if bad_rows.any():
        why = "hold values that are not finite"
        refuse("a batch is not finite", bad_rows, why, LEAVE_OUT, rows(), run, steps)
    if bad_td.any():
        what = "the loss is not finite"
        why = "have such TD errors"
        if bad_td.all():
            why += ", after an update that made the parameters NaN or infinite"
        refuse(what, bad_td, why, TRAIN_SLOWER, rows(), run, steps)


def refuse(
    what: str,
    bad: Bools,
    why: str,
    remedy: str,
    rows: Sequence[dict[str, Any]],
    run: Path | None,
    steps: Mapping[str, int],
    rows_before: Sequence[dict[str, Any]] = (),
) -> NoReturn:
    """Write the rows to `not_finite.json` in the run, if there is a run, and raise NotFinite."""
    named = [row for row, is_bad in zip(rows, bad, strict=True) if is_bad]
    message = f"{what} at update {steps['gradient_steps']}"
    if named:
        more = f" and {len(named) - _NAMED} more" if len(named) > _NAMED else ""
        message += f"; {len(named)} of the {len(rows)} rows of the batch {why}:"
        message += f" {', '.join(map(_describe_row, named[:_NAMED]))}{more}"
    if run is not None:
        document = {
            **steps,
            "what": what,
            "rows": [{**row, "named": bool(is_bad)} for row, is_bad in zip(rows, bad, strict=True)],
            "rows_before": list(rows_before),
        }
        write_text(run / STOPPED, json.dumps(document, indent=1) + "\n")
        message += f"; all are in {STOPPED}" if rows else ""
        message += ", with those of the batch before" if rows_before else ""
    raise NotFinite(message, where=None if run is None else str(run), remedy=remedy)


def _describe_row(row: dict[str, Any]) -> str:
    if row["source"] == "logs":
        return f"panel row {row['panel_row']} (transition {row['transition_id']})"
    return f"step {row['episode_step']} of the twin's episode {row['episode']}"
