"""What the critic was fed: exact sums over every batch, and every row of a seeded few.

A batch's rows, strata, TD errors and values are kept as they are sampled (no statistics inside the
update loop) and summed once an interval. The sums go to the run's tables `strata`, `conditions`,
`ages`, `sampled_episodes` and `policies`; the rows of audited batches to `audit`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from restock.replay.ring.ring import FreshRing
from restock.state import Stateful
from restock.train.dqn.loss import Loss
from restock.train.feed.batches import ReplayBatch
from restock.train.feed.fresh_log import FreshPerturbations
from restock.train.feed.logs import Logs
from restock.train.feed.sampled_rows import (
    FRESH,
    LOGGED,
    Columns,
    SampledRows,
    episode_sums,
    fresh_audit,
    logged_audit,
    row_hashes,
)
from restock.train.run.run import Run

UNLABELLED = "unlabelled"
_NS_PER_DAY = 86_400e9
_MEANS = ("td_abs_mean", "q_mean", "q_abs_max", "reward_mean", "logs_share")


@dataclass(frozen=True)
class _Source:
    """The rows (n,) of an interval that came from one source, and what their codes name."""

    name: str  # logs | fresh
    rows: Mapping[str, NDArray[Any]]  # td, q, weight, reward, discount
    stratum: NDArray[np.int64]
    strata: Sequence[str]
    row: NDArray[np.int64]  # which row of the source each was
    available: NDArray[np.int64]  # (S,) rows of each stratum that the source has
    timings: Sequence[str | None]  # (S,)
    quota: Sequence[float | None]  # (S,)
    condition: NDArray[np.int64]
    conditions: Sequence[str]
    episode: NDArray[np.int64]
    policy: NDArray[np.int64]
    policies: Sequence[str]


class FeedRecord(Stateful):
    """Records the batches of a run.

    Args:
        audit_share: of all batches, chosen by `seed`.
        perturbations: in force in the ring's episodes, where they are known.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        "_rng",
        "_total",
        "_logged",
        "_fresh",
        "_quota",
        "_quota_batches",
    )

    def __init__(
        self,
        run: Run,
        logs: Logs | None,
        ring: FreshRing,
        *,
        audit_share: float,
        seed: int,
        perturbations: FreshPerturbations | None = None,
    ) -> None:
        self.run, self.logs, self.ring = run, logs, ring
        self.perturbations = perturbations
        self.audit_share = audit_share
        self._rng = np.random.default_rng([seed, 4])
        self._age_days = (
            np.maximum(logs.as_of_ns - logs.stamp_ns, 0) / _NS_PER_DAY if logs is not None else None
        )
        # Rows since the run began, by stratum: (S,) of each source.
        sizes = {"logs": 0 if logs is None else len(logs.strata), "fresh": len(ring.conditions) + 1}
        self._total = {name: np.zeros(size, np.int64) for name, size in sizes.items()}
        self._logged, self._fresh = SampledRows(LOGGED), SampledRows(FRESH)
        # Of batches with logged rows in the open interval: the sum (S,) of the shares in force.
        self._quota = np.zeros(sizes["logs"])
        self._quota_batches = 0
        # Of the last two batches: rows of the panel, the ring's episodes, and their steps.
        none: NDArray[np.int64] = np.empty(0, np.int64)
        self._last: tuple[NDArray[np.int64], ...] = (none, none, none)
        self._before: tuple[NDArray[np.int64], ...] = self._last

    def batch(
        self, step: int, env_steps: int, batch: ReplayBatch, loss: Loss, last_sync: int
    ) -> None:
        """Keep the batch of gradient step `step` (from 1), and its audit rows if it is chosen.

        Inside the update loop: only what will not be there any more when the interval is closed.
        """
        slots, logged = batch.slots, batch.logged
        td, q = loss.td.cpu().numpy(), loss.q.cpu().numpy()
        weight = np.ones_like(td) if batch.weight is None else batch.weight.cpu().numpy()
        tail = batch.rows[:, -2:].cpu().numpy().copy()  # the buffer is filled again
        if logged:
            self._logged.append(
                batch.log_rows,
                batch.log_stratum,
                td[:logged],
                q[:logged],
                weight[:logged],
                tail[:logged, 0],
                tail[:logged, 1],
            )
            self._quota += batch.quota
            self._quota_batches += 1
        meta = self.ring.meta
        episode, episode_step = meta["episode"][slots], meta["episode_step"][slots]
        self._before, self._last = self._last, (batch.log_rows, episode, episode_step)
        if len(slots):
            self._fresh.append(
                self.ring.condition(slots),
                episode,
                episode_step,
                meta["behaviour_policy"][slots],
                env_steps - meta["env_step"][slots],
                step - meta["gradient_step"][slots],
                td[logged:],
                q[logged:],
                weight[logged:],
                tail[logged:, 0],
                tail[logged:, 1],
            )
        if self._rng.random() < self.audit_share:
            self._audit(step, batch, last_sync)

    def last_batch(self, *, before: bool = False) -> list[dict[str, Any]]:
        """The ids of the rows of the batch last kept, or of the one before it, in its order."""
        batch = self._before if before else self._last
        panel_row, episode, episode_step = (values.tolist() for values in batch)
        known = [] if self.logs is None else self.logs.transition_id[batch[0]].tolist()
        logged = zip(panel_row, known, strict=True)
        fresh = zip(episode, episode_step, strict=True)
        return [
            *({"source": "logs", "panel_row": row, "transition_id": key} for row, key in logged),
            *({"source": "fresh", "episode": key, "episode_step": step} for key, step in fresh),
        ]

    def flush(self, env_steps: int, gradient_steps: int, phase: str) -> dict[str, float | None]:
        """Write the interval's sums; returns its means, for `progress`."""
        steps = {"env_steps": env_steps, "gradient_steps": gradient_steps}
        sources = [*self._of_logs(), *self._of_ring()]
        for source in sources:
            self._strata(source, steps, phase)
            self._conditions(source, steps, phase)
            self._ages(source, steps)
            self._episodes(source, steps)
            self._policies(source, steps)
        if not sources:
            return dict.fromkeys(_MEANS)
        td, q, reward = (
            np.concatenate([source.rows[name] for source in sources])
            for name in ("td", "q", "reward")
        )
        means: dict[str, float | None] = {
            "td_abs_mean": float(np.abs(td).mean()),
            "q_mean": float(q.mean()),
            "q_abs_max": float(np.abs(q).max()),
            "reward_mean": float(reward.mean()),
            "logs_share": len(self._logged) / len(td),
        }
        self._logged.clear()
        self._fresh.clear()
        self._quota[:], self._quota_batches = 0.0, 0
        return means

    def _of_logs(self) -> list[_Source]:
        logs, rows = self.logs, self._logged.columns
        if logs is None or not len(self._logged):
            return []
        row = rows["row"]
        return [
            _Source(
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
                policy=logs.behaviour_policy.codes[row],
                policies=logs.behaviour_policy.names,
            )
        ]

    def _of_ring(self) -> list[_Source]:
        ring, rows = self.ring, self._fresh.columns
        if not len(self._fresh):
            return []
        names, labelled = [*ring.conditions, UNLABELLED], ring.strata.counts
        condition = rows["condition"].astype(np.int64)
        stratum = np.where(condition < 0, len(ring.conditions), condition)
        unknown = [None] * len(names)
        return [
            _Source(
                name="fresh",
                rows=rows,
                stratum=stratum,  # a ring's strata are conditions
                strata=names,
                row=(rows["episode"] << 20) | rows["episode_step"],
                available=np.append(labelled, len(ring) - labelled.sum()),
                timings=unknown,
                quota=unknown,
                condition=stratum,
                conditions=names,
                episode=rows["episode"],
                policy=rows["policy"],
                policies=ring.behaviour_policies,
            )
        ]

    def _strata(self, source: _Source, steps: dict[str, int], phase: str) -> None:
        size, stratum, rows = len(source.strata), source.stratum, source.rows
        drawn = np.bincount(stratum, minlength=size)
        weight = np.bincount(stratum, rows["weight"], minlength=size)
        # Per stratum: a fresh row moves from "unlabelled" to its stratum when its episode ends.
        unique = np.bincount(np.unique(source.row * size + stratum) % size, minlength=size)
        replays = [n / u if u else None for n, u in zip(drawn, unique, strict=True)]
        total = self._total[source.name]
        total += drawn

        def mean(values: NDArray[Any]) -> list[float | None]:
            sums = np.bincount(stratum, values, minlength=size).tolist()
            return [x / n if n else None for x, n in zip(sums, drawn.tolist(), strict=True)]

        self.run.append_columns(
            "strata",
            {
                **steps,
                "phase": phase,
                "source": source.name,
                "stratum": source.strata,
                "timing": source.timings,
                "quota_share": source.quota,
                "available_rows": source.available,
                "available_share": source.available / max(source.available.sum(), 1),
                "drawn_rows": drawn,
                "drawn_share": drawn / len(stratum),
                "effective_share": weight / max(weight.sum(), 1e-12),
                "unique_rows": unique,
                "replays_per_row": replays,
                "total_drawn_rows": total.copy(),
                "td_abs_mean": mean(np.abs(rows["td"])),
                "q_mean": mean(rows["q"]),
                "reward_mean": mean(rows["reward"]),
                "terminal_share": mean(rows["discount"] == 0),
            },
        )

    def _conditions(self, source: _Source, steps: dict[str, int], phase: str) -> None:
        code, size = source.condition, len(source.conditions)
        drawn = np.bincount(code, minlength=size)
        weight, td, q = (
            np.bincount(code, values, minlength=size)
            for values in (source.rows["weight"], np.abs(source.rows["td"]), source.rows["q"])
        )
        met = np.flatnonzero(drawn)
        self.run.append_columns(
            "conditions",
            {
                **steps,
                "phase": phase,
                "source": source.name,
                "condition": np.array(source.conditions, object)[met],
                "drawn_rows": drawn[met],
                "drawn_share": drawn[met] / len(code),
                "effective_share": weight[met] / max(weight.sum(), 1e-12),
                "td_abs_mean": td[met] / drawn[met],
                "q_mean": q[met] / drawn[met],
            },
        )

    def _ages(self, source: _Source, steps: dict[str, int]) -> None:
        ages = {
            unit: source.rows[f"age_{unit}"].astype(np.float64)
            for unit in ("env_steps", "gradient_steps")
            if source.name == "fresh"
        }
        if source.name == "logs" and self._age_days is not None:
            ages["days"] = self._age_days[source.row]
        for unit, age in ages.items():
            bucket = np.where(age < 1, -1, np.floor(np.log2(np.maximum(age, 1)))).astype(np.int32)
            buckets, counts = np.unique(bucket, return_counts=True)
            quantiles = np.quantile(age, [0.5, 0.9, 0.99]).tolist()
            self.run.append_columns(
                "ages",
                {
                    **steps,
                    "source": source.name,
                    "unit": unit,
                    "bucket": buckets,
                    "count": counts,
                    **dict(zip(("p50", "p90", "p99"), quantiles, strict=True)),
                },
            )

    def _episodes(self, source: _Source, steps: dict[str, int]) -> None:
        sums = episode_sums(
            source.episode, source.stratum, source.rows["weight"], len(source.strata)
        )
        key = sums["episode"]
        if source.name == "logs" and self.logs is not None:
            episode = np.array(self.logs.episode.names, object)[key]
        else:
            episode = key.astype(str)
        stratum = np.array(source.strata, object)[sums["stratum"]]
        self.run.append_columns(
            "sampled_episodes",
            {**steps, "source": source.name, **sums, "stratum": stratum, "episode": episode},
        )

    def _policies(self, source: _Source, steps: dict[str, int]) -> None:
        counts = np.bincount(source.policy, minlength=len(source.policies)).tolist()
        rows = [
            {**steps, "source": source.name, "behaviour_policy": name, "rows": count}
            for name, count in zip(source.policies, counts, strict=True)
            if count
        ]
        self.run.append("policies", rows)

    def _audit(self, step: int, batch: ReplayBatch, last_sync: int) -> None:
        """Every row of the batch last kept."""
        packed, logged = batch.rows.cpu().numpy(), batch.logged
        hashes, action = row_hashes(packed), packed[:, -3].astype(np.int16)
        parts: list[tuple[slice, Columns]] = []
        if logged and self.logs is not None and self._age_days is not None:
            rows = logged_audit(self._logged.last, self.logs, self._age_days)
            parts.append((slice(logged), rows))
        if len(batch.slots):
            rows = fresh_audit(
                self._fresh.last, batch.slots, self.ring, UNLABELLED, self.perturbations
            )
            parts.append((slice(logged, len(packed)), rows))
        place = np.arange(len(packed))
        for part, columns in parts:
            self.run.append_columns(
                "audit",
                {
                    "gradient_step": step,
                    "batch_row": place[part],
                    **columns,
                    "action": action[part],
                    "last_target_sync": last_sync,
                    "row_hash": hashes[part],
                },
            )


__all__ = ["UNLABELLED", "FeedRecord"]
