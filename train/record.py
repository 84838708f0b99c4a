"""What the critic was fed: exact sums over every batch, and every row of a seeded few.

A batch's rows, strata, TD errors and values are kept as they are drawn (no statistics inside the
update loop) and summed once an interval. The sums go to the run's tables `strata`, `ages` and
`policies`; the rows of audited batches to `audit`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.replay.ring import FreshRing
from restock.train.batches import Batch, Logs
from restock.train.checkpoint import generator_state, restore_generator
from restock.train.loss import Loss
from restock.train.run import Run

UNLABELLED = "unlabelled"
_NS_PER_DAY = 86_400e9


@dataclass(frozen=True, slots=True)
class _Kept:
    """What a batch was, as it was drawn: L rows of logs and F fresh ones, B = L + F."""

    step: int
    env_steps: int
    log_row: NDArray[np.int64]  # (L,)
    log_stratum: NDArray[np.int64]  # (L,)
    code: NDArray[np.int16]  # (F,) condition of each fresh row, -1 while unlabelled
    episode: NDArray[np.int64]  # (F,)
    episode_step: NDArray[np.int32]  # (F,)
    policy: NDArray[np.int16]  # (F,)
    env_step: NDArray[np.int64]  # (F,) when it was collected
    gradient_step: NDArray[np.int64]  # (F,)
    td: NDArray[np.float32]  # (B,)
    q: NDArray[np.float32]  # (B,)
    weight: NDArray[np.float32] | None  # (B,)
    tail: NDArray[np.float32]  # (B, 2) reward, discount


# The arrays of a batch that a checkpoint keeps, and which of its rows they are about.
_ARRAYS = {
    **dict.fromkeys(("log_row", "log_stratum"), "log"),
    **dict.fromkeys(
        ("code", "episode", "episode_step", "policy", "env_step", "gradient_step"), "fresh"
    ),
    **dict.fromkeys(("td", "q", "tail"), "both"),
}


def _logged(values: NDArray[Any], batch: _Kept) -> NDArray[Any]:
    return values[: len(batch.log_row)]


def _fresh(values: NDArray[Any], batch: _Kept) -> NDArray[Any]:
    return values[len(batch.log_row) :]


class FeedRecord:
    """Records the batches of a run.

    Args:
        audit_share: of all batches, chosen by `seed`.
    """

    def __init__(
        self,
        run: Run,
        logs: Logs | None,
        ring: FreshRing,
        *,
        audit_share: float,
        seed: int,
    ) -> None:
        self.run, self.logs, self.ring = run, logs, ring
        self.audit_share = audit_share
        self._rng = np.random.default_rng([seed, 4])
        self._age_days = (
            np.maximum(logs.as_of_ns - logs.stamp_ns, 0) / _NS_PER_DAY if logs is not None else None
        )
        self._fresh_strata = [*ring.conditions, UNLABELLED]
        self._drawn: dict[str, int] = {}  # "source/stratum" -> rows since the run began
        self._kept: list[_Kept] = []

    def batch(self, step: int, env_steps: int, batch: Batch, loss: Loss, last_sync: int) -> None:
        """Keep the batch of gradient step `step` (from 1), and its audit rows if it is chosen.

        Inside the update loop: only what will not be there any more when the interval is closed.
        """
        ring, slots = self.ring, batch.slots
        meta = ring.meta
        kept = _Kept(
            step=step,
            env_steps=env_steps,
            log_row=batch.log_rows,
            log_stratum=batch.log_stratum,
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
            self._audit(step, batch, self._columns([kept]), last_sync)

    def _columns(self, kept: Sequence[_Kept]) -> dict[str, NDArray[Any]]:
        """Batches as columns over all their rows, logs and fresh apart."""

        def joined(name: str) -> NDArray[Any]:
            return np.concatenate([getattr(batch, name) for batch in kept])

        fresh = [len(batch.code) for batch in kept]
        code = joined("code")
        columns = {
            "log_row": joined("log_row"),
            "log_stratum": joined("log_stratum"),
            "fresh_stratum": np.where(code < 0, len(self.ring.conditions), code),
            "fresh_key": (joined("episode") << 20) | joined("episode_step"),
            "fresh_policy": joined("policy"),
            "age_env_steps": np.repeat([b.env_steps for b in kept], fresh) - joined("env_step"),
            "age_gradient_steps": np.repeat([b.step for b in kept], fresh)
            - joined("gradient_step"),
        }
        for side, part in (("log", _logged), ("fresh", _fresh)):
            for name in ("td", "q"):
                columns[f"{side}_{name}"] = np.concatenate(
                    [part(getattr(batch, name), batch) for batch in kept]
                )
            columns[f"{side}_weight"] = np.concatenate(
                [
                    np.ones(len(part(batch.td, batch)), np.float32)
                    if batch.weight is None
                    else part(batch.weight, batch)
                    for batch in kept
                ]
            )
            tail = np.concatenate([part(batch.tail, batch) for batch in kept])
            columns[f"{side}_reward"], columns[f"{side}_discount"] = tail[:, 0], tail[:, 1]
        return columns

    def flush(self, env_steps: int, gradient_steps: int, phase: str) -> dict[str, float | None]:
        """Write the interval's sums; returns its means, for `progress`."""
        clocks = {"env_steps": env_steps, "gradient_steps": gradient_steps}
        if not self._kept:
            return dict.fromkeys(
                ("td_abs_mean", "q_mean", "q_abs_max", "reward_mean", "logs_share")
            )
        kept, self._kept = self._columns(self._kept), []
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
            quota=list(logs.shares),
        )
        if self._age_days is not None:
            self._ages("logs", "days", self._age_days[kept["log_row"]], clocks)
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
        for unit in ("env_steps", "gradient_steps"):
            self._ages("fresh", unit, kept[f"age_{unit}"].astype(np.float64), clocks)
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
        action = packed[:, -3].astype(np.int16)
        hashes = [hashlib.blake2b(row.tobytes(), digest_size=8).hexdigest() for row in packed]
        rows: list[dict[str, Any]] = []
        for place in range(len(packed)):
            logged = place < batch.logged
            side, at = ("log", place) if logged else ("fresh", place - batch.logged)
            own = self._log_row(columns, at) if logged else self._fresh_row(batch, columns, at)
            rows.append(
                {
                    "gradient_step": step,
                    "batch_row": place,
                    **own,
                    "action": int(action[place]),
                    **{
                        name: float(columns[f"{side}_{name}"][at])
                        for name in ("reward", "discount", "weight", "q", "td")
                    },
                    "last_target_sync": last_sync,
                    "row_hash": hashes[place],
                }
            )
        self.run.append("audit", rows)

    def _log_row(self, columns: Mapping[str, NDArray[Any]], at: int) -> dict[str, Any]:
        logs, row = self.logs, int(columns["log_row"][at])
        if logs is None or self._age_days is None:
            raise RuntimeError("a batch of logs without logs")
        return {
            "source": "logs",
            "transition_id": int(logs.transition_id[row]),
            "ring_slot": None,
            "episode": logs.episode.name(row),
            "age_days": float(self._age_days[row]),
            "age_env_steps": None,
            "age_gradient_steps": None,
            "stratum": logs.strata[columns["log_stratum"][at]],
            "condition": logs.condition.name(row),
            "behaviour_policy": logs.behaviour_policy.name(row),
            "behaviour_version": logs.behaviour_version.name(row),
        }

    def _fresh_row(
        self, batch: Batch, columns: Mapping[str, NDArray[Any]], at: int
    ) -> dict[str, Any]:
        ring, slot = self.ring, int(batch.slots[at])
        stratum = self._fresh_strata[columns["fresh_stratum"][at]]
        return {
            "source": "fresh",
            "transition_id": None,
            "ring_slot": slot,
            "episode": str(int(ring.meta["episode"][slot])),
            "age_days": None,
            "age_env_steps": int(columns["age_env_steps"][at]),
            "age_gradient_steps": int(columns["age_gradient_steps"][at]),
            "stratum": stratum,
            "condition": None if stratum == UNLABELLED else stratum,
            "behaviour_policy": ring.behaviour_policies[columns["fresh_policy"][at]],
            "behaviour_version": str(int(ring.meta["policy_version"][slot])),
        }

    def state_dict(self) -> dict[str, Any]:
        """Arrays and JSON values: the totals, the audit's generator and the open interval."""
        kept = self._kept
        joined = {}
        for name in _ARRAYS if kept else ():
            joined[name] = np.concatenate([getattr(batch, name) for batch in kept])
        weights = [b.weight if b.weight is not None else np.ones_like(b.td) for b in kept]
        return {
            "rng": generator_state(self._rng),
            "drawn": dict(self._drawn),
            "clocks": [[b.step, b.env_steps, len(b.log_row), len(b.code)] for b in kept],
            "weight": np.concatenate(weights) if kept else None,
            **joined,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Puts the record where `state_dict` found it."""
        restore_generator(self._rng, state["rng"])
        self._drawn = {name: int(count) for name, count in state["drawn"].items()}
        self._kept = []
        logged = fresh = 0
        for step, env_steps, log_rows, slots in state["clocks"]:
            places = {
                "log": slice(logged, logged + log_rows),
                "fresh": slice(fresh, fresh + slots),
                "both": slice(logged + fresh, logged + fresh + log_rows + slots),
            }
            arrays = {name: state[name][places[side]] for name, side in _ARRAYS.items()}
            weight = state["weight"][places["both"]]
            self._kept.append(_Kept(step=step, env_steps=env_steps, weight=weight, **arrays))
            logged, fresh = logged + log_rows, fresh + slots
