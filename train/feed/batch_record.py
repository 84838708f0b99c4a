"""What the critic was fed: exact sums over every batch, and every row of a seeded few.

A batch's rows, strata, TD errors and values are kept as they are drawn (no statistics inside the
update loop) and summed once an interval. The sums go to the run's tables `strata`, `ages` and
`policies`; the rows of audited batches to `audit`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.replay.ring.ring import FreshRing
from restock.train.dqn.loss import Loss
from restock.train.feed.audit_rows import fresh_rows, logged_rows, row_hashes
from restock.train.feed.batches import Batch
from restock.train.feed.drawn import BatchRecord, as_columns, from_state, to_state
from restock.train.feed.fresh_log import FreshPerturbations
from restock.train.feed.logs import Logs
from restock.train.feed.sampled_episodes import episode_columns
from restock.train.run.checkpoint import generator_state, restore_generator
from restock.train.run.run import Run

UNLABELLED = "unlabelled"
_NS_PER_DAY = 86_400e9


class FeedRecord:
    """Records the batches of a run.

    Args:
        audit_share: of all batches, chosen by `seed`.
        perturbations: in force in the ring's episodes, where they are known.
    """

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
        self._fresh_strata = [*ring.conditions, UNLABELLED]
        self._drawn: dict[str, int] = {}  # "source/stratum" -> rows since the run began
        self._kept: list[BatchRecord] = []

    def batch(self, step: int, env_steps: int, batch: Batch, loss: Loss, last_sync: int) -> None:
        """Keep the batch of gradient step `step` (from 1), and its audit rows if it is chosen.

        Inside the update loop: only what will not be there any more when the interval is closed.
        """
        ring, slots = self.ring, batch.slots
        meta = ring.meta
        kept = BatchRecord(
            step=step,
            env_steps=env_steps,
            log_row=batch.log_rows,
            log_stratum=batch.log_stratum,
            quota=batch.quota,
            code=ring.condition(slots),
            episode=meta["episode"][slots],
            episode_step=meta["episode_step"][slots],
            policy=meta["behaviour_policy"][slots],
            env_step=meta["env_step"][slots],
            gradient_step=meta["gradient_step"][slots],
            td=loss.td.cpu().numpy(),
            q=loss.q.cpu().numpy(),
            weight=None if batch.weight is None else batch.weight.cpu().numpy(),
            tail=batch.rows[:, -2:].cpu().numpy().copy(),  # the buffer is filled anew
        )
        self._kept.append(kept)
        if self._rng.random() < self.audit_share:
            self._audit(step, batch, as_columns([kept], len(ring.conditions)), last_sync)

    def flush(self, env_steps: int, gradient_steps: int, phase: str) -> dict[str, float | None]:
        """Write the interval's sums; returns its means, for `progress`."""
        clocks = {"env_steps": env_steps, "gradient_steps": gradient_steps}
        if not self._kept:
            return dict.fromkeys(
                ("td_abs_mean", "q_mean", "q_abs_max", "reward_mean", "logs_share")
            )
        kept, self._kept = as_columns(self._kept, len(self.ring.conditions)), []
        if self.logs is not None and len(kept["log_row"]):
            self._log_tables(kept, clocks, phase, self.logs)
        if len(kept["fresh_stratum"]):
            self._fresh_tables(kept, clocks, phase)
        td = np.concatenate([kept["log_td"], kept["fresh_td"]])
        q = np.concatenate([kept["log_q"], kept["fresh_q"]])
        reward = np.concatenate([kept["log_reward"], kept["fresh_reward"]])
        return {
            "td_abs_mean": float(np.abs(td).mean()),
            "q_mean": float(q.mean()),
            "q_abs_max": float(np.abs(q).max()),
            "reward_mean": float(reward.mean()),
            "logs_share": len(kept["log_row"]) / len(td),
        }

    def _log_tables(
        self, kept: dict[str, NDArray[Any]], clocks: dict[str, int], phase: str, logs: Logs
    ) -> None:
        available = np.array([len(rows) for rows in logs.stratum_rows])
        self._strata(
            "logs",
            logs.strata,
            kept["log_stratum"],
            kept["log_row"],
            {name: kept[f"log_{name}"] for name in ("td", "q", "weight", "reward", "discount")},
            available,
            {**clocks, "phase": phase},
            timing=logs.timings,
            quota=kept["log_quota"].tolist(),
        )
        condition = logs.condition
        codes = condition.codes[kept["log_row"]]
        self._conditions("logs", condition.names, codes, kept, {**clocks, "phase": phase})
        if self._age_days is not None:
            self._ages("logs", "days", self._age_days[kept["log_row"]], clocks)
        self._episodes("logs", logs.episode.codes[kept["log_row"]], kept, logs.strata, clocks)
        policy = logs.behaviour_policy
        counts = np.bincount(policy.codes[kept["log_row"]], minlength=len(policy.names))
        self._policies("logs", policy.names, counts, clocks)

    def _fresh_tables(
        self, kept: dict[str, NDArray[Any]], clocks: dict[str, int], phase: str
    ) -> None:
        ring, names = self.ring, self._fresh_strata
        labelled = ring.strata.counts
        self._strata(
            "fresh",
            names,
            kept["fresh_stratum"],
            kept["fresh_key"],
            {name: kept[f"fresh_{name}"] for name in ("td", "q", "weight", "reward", "discount")},
            np.append(labelled, len(ring) - labelled.sum()),
            {**clocks, "phase": phase},
            timing=[None] * len(names),
            quota=[None] * len(names),
        )
        codes = kept["fresh_stratum"]  # a ring's strata are conditions
        self._conditions("fresh", names, codes, kept, {**clocks, "phase": phase})
        for unit in ("env_steps", "gradient_steps"):
            self._ages("fresh", unit, kept[f"age_{unit}"].astype(np.float64), clocks)
        self._episodes("fresh", kept["fresh_key"] >> 20, kept, names, clocks)
        counts = np.bincount(kept["fresh_policy"], minlength=len(ring.behaviour_policies))
        self._policies("fresh", ring.behaviour_policies, counts, clocks)

    def _strata(
        self,
        source: str,
        names: list[str],
        stratum: NDArray[Any],
        row: NDArray[Any],
        values: dict[str, NDArray[Any]],
        available: NDArray[Any],
        clocks: dict[str, Any],
        *,
        timing: list[Any],
        quota: list[Any],
    ) -> None:
        size = len(names)
        drawn = np.bincount(stratum, minlength=size)
        weight = np.bincount(stratum, values["weight"], minlength=size)
        # Per stratum: a fresh row moves from "unlabelled" to its stratum when its episode ends.
        unique = np.bincount(np.unique(row * size + stratum) % size, minlength=size)
        of_drawn = np.maximum(drawn, 1)
        means = {
            "td_abs_mean": np.bincount(stratum, np.abs(values["td"]), minlength=size) / of_drawn,
            "q_mean": np.bincount(stratum, values["q"], minlength=size) / of_drawn,
            "reward_mean": np.bincount(stratum, values["reward"], minlength=size) / of_drawn,
            "terminal_share": np.bincount(stratum, values["discount"] == 0, minlength=size)
            / of_drawn,
        }
        rows = []
        for index, name in enumerate(names):
            key = f"{source}/{name}"
            self._drawn[key] = self._drawn.get(key, 0) + int(drawn[index])
            seen = bool(drawn[index])
            rows.append(
                {
                    **clocks,
                    "source": source,
                    "stratum": name,
                    "timing": timing[index],
                    "quota_share": quota[index],
                    "available_rows": int(available[index]),
                    "available_share": float(available[index] / max(available.sum(), 1)),
                    "drawn_rows": int(drawn[index]),
                    "drawn_share": float(drawn[index] / len(stratum)),
                    "effective_share": float(weight[index] / max(weight.sum(), 1e-12)),
                    "unique_rows": int(unique[index]),
                    "replays_per_row": float(drawn[index] / unique[index]) if seen else None,
                    "total_drawn_rows": self._drawn[key],
                    **{k: float(v[index]) if seen else None for k, v in means.items()},
                }
            )
        self.run.append("strata", rows)

    def _conditions(
        self,
        source: str,
        names: list[str],
        code: NDArray[Any],
        kept: dict[str, NDArray[Any]],
        clocks: dict[str, Any],
    ) -> None:
        """`code` (n,) are the drawn rows' conditions."""
        side = "log" if source == "logs" else "fresh"
        drawn = np.bincount(code, minlength=len(names))
        weight, td, q = (
            np.bincount(code, values, minlength=len(names))
            for values in (kept[f"{side}_weight"], np.abs(kept[f"{side}_td"]), kept[f"{side}_q"])
        )
        met = np.flatnonzero(drawn)
        self.run.append_columns(
            "conditions",
            {
                **clocks,
                "source": source,
                "condition": np.array(names, object)[met],
                "drawn_rows": drawn[met],
                "drawn_share": drawn[met] / len(code),
                "effective_share": weight[met] / max(weight.sum(), 1e-12),
                "td_abs_mean": td[met] / drawn[met],
                "q_mean": q[met] / drawn[met],
            },
        )

    def _ages(
        self, source: str, unit: str, age: NDArray[np.float64], clocks: dict[str, int]
    ) -> None:
        bucket = np.where(age < 1, -1, np.floor(np.log2(np.maximum(age, 1)))).astype(np.int32)
        buckets, counts = np.unique(bucket, return_counts=True)
        p50, p90, p99 = (float(value) for value in np.quantile(age, [0.5, 0.9, 0.99]))
        self.run.append_columns(
            "ages",
            {
                **clocks,
                "source": source,
                "unit": unit,
                "bucket": buckets,
                "count": counts,
                "p50": p50,
                "p90": p90,
                "p99": p99,
            },
        )

    def _episodes(
        self,
        source: str,
        episode: NDArray[Any],
        kept: dict[str, NDArray[Any]],
        strata: list[str],
        clocks: dict[str, int],
    ) -> None:
        side = "log" if source == "logs" else "fresh"
        columns = episode_columns(
            episode, kept[f"{side}_stratum"], kept[f"{side}_weight"], len(strata)
        )
        named = np.array(strata, object)[columns["stratum"]]
        keys: Any = columns["episode"]
        if source == "logs" and self.logs is not None:
            names = np.array(self.logs.episode.names, object)[keys]
        else:
            names = keys.astype(str)
        self.run.append_columns(
            "sampled_episodes",
            {**clocks, "source": source, **columns, "stratum": named, "episode": names},
        )

    def _policies(
        self, source: str, names: Any, counts: NDArray[Any], clocks: dict[str, int]
    ) -> None:
        rows = [
            {**clocks, "source": source, "behaviour_policy": name, "rows": int(count)}
            for name, count in zip(names, counts, strict=True)
            if count
        ]
        self.run.append("policies", rows)

    def _audit(
        self, step: int, batch: Batch, columns: Mapping[str, NDArray[Any]], last_sync: int
    ) -> None:
        packed = batch.rows.cpu().numpy()
        hashes, action = row_hashes(packed), packed[:, -3].astype(np.int16)
        parts: list[tuple[slice, dict[str, Any]]] = []
        if batch.logged and self.logs is not None and self._age_days is not None:
            logged = logged_rows(columns, self.logs, self._age_days)
            parts.append((slice(0, batch.logged), logged))
        if len(batch.slots):
            fresh = fresh_rows(columns, batch, self.ring, self._fresh_strata, self.perturbations)
            parts.append((slice(batch.logged, len(packed)), fresh))
        for place, own in parts:
            self.run.append_columns(
                "audit",
                {
                    "gradient_step": step,
                    "batch_row": np.arange(place.start, place.stop),
                    **own,
                    "action": action[place],
                    "last_target_sync": last_sync,
                    "row_hash": hashes[place],
                },
            )

    def state_dict(self) -> dict[str, Any]:
        """Arrays and JSON values: the totals, the audit's generator and the open interval."""
        return {
            "rng": generator_state(self._rng),
            "drawn": dict(self._drawn),
            "kept": to_state(self._kept),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Puts the record where `state_dict` found it."""
        restore_generator(self._rng, state["rng"])
        self._drawn = {name: int(count) for name, count in state["drawn"].items()}
        self._kept = from_state(state["kept"])
