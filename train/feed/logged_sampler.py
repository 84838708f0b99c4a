"""The logged rows of batches: by the diet's shares, and no row more often than it may be drawn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from restock.replay.mixture.mixture import Prioritised, Within
from restock.replay.mixture.packed_row import F32, F64, Ints
from restock.replay.panel.plan import outcome_column
from restock.replay.panel.strata import rules_of
from restock.replay.panel.weights import WeightsInForce
from restock.replay.sampling.chunked import ChunkedSampler
from restock.replay.sampling.sampler import Sampler
from restock.replay.sampling.share_controller import Diet, FedStratum, PlannedDraws
from restock.replay.sampling.within_stratum import panel_sampler
from restock.train.dqn.checkpoint import generator_state, restore_generator

if TYPE_CHECKING:
    from restock.replay.panel.panel import Panel
    from restock.train.feed.batches import Logs


@dataclass(frozen=True)
class Drawing:
    """The logged rows of one batch."""

    rows: Ints  # (L,) of the panel
    strata: Ints  # (L,)
    weight: F32 | None  # (L,) importance weights; None for ones
    quota: F64  # (S,) the shares they were drawn by


class LogDraws:
    """Draws of one run from its logs.

    `diet` says in which shares; the sampler draws by them; what would be drawn more often than the
    mixture's `max_replays_per_row` is replaced by a row of the same stratum that may still be
    drawn, else by one of another stratum, else by nothing.

    Raises:
        MixtureError: see `Diet`.
    """

    def __init__(self, logs: Logs, logs_share: float | None, batch_size: int, seed: int) -> None:
        self.logs = logs
        panel = logs.panel
        sizes = [len(rows) for rows in logs.stratum_rows]
        self.diet = (
            Diet.fixed(logs.strata, sizes, logs.shares, logs_share or 0.0)
            if panel is None
            else diet_of(panel, logs.planned, logs_share)
        )
        rng = np.random.default_rng([seed, 2])
        shares = self.diet.shares
        self.sampler: Sampler
        if panel is not None and panel.header.mixture.sampling == "chunked":
            self.sampler = ChunkedSampler(panel.rows, logs.stratum_rows, shares, batch_size, rng)
        else:
            within: list[Within] = ["without_replacement"] * len(shares)
            numbers = Prioritised()
            if panel is not None:
                within = [stratum.within for stratum in panel.strata]
                numbers = panel.header.mixture.prioritised
            self.sampler = panel_sampler(
                within,
                logs.stratum_rows,
                shares,
                batch_size,
                rng,
                numbers,
                lap_floor=logs.huber_delta,
            )
        prioritised = panel is not None and any(s.within in ("per", "lap") for s in panel.strata)
        adaptive = panel is not None and panel.header.mixture.adaptive is not None
        self.listens = prioritised or adaptive  # to TD errors
        self._weights = None if panel is None else _weights(panel)
        if self._weights is not None:
            self._weights.set_shares(shares)
        # Draws of each row so far, where there is a limit to them.
        cap = self.diet.max_replays
        self.replays: NDArray[np.int32] | None = None
        if cap is not None:
            self.replays = np.zeros(len(logs), np.int32)
        self._budget: Ints = (cap or 0) * np.array([len(rows) for rows in logs.stratum_rows])
        self._swapped = False  # rows of the last batch, for the cap
        self.replaced: Ints = np.zeros(len(shares), np.int64)  # rows of each stratum, for the cap
        self._rng = np.random.default_rng([seed, 3])

    @property
    def gathers(self) -> bool:
        """Whether `gather` must be asked for the rows: they are not in memory."""
        return isinstance(self.sampler, ChunkedSampler)

    def move_to(self, env_steps: int) -> None:
        """Before an online batch is drawn: shares with a schedule move with the steps."""
        if self.diet.at(env_steps):
            self._follow()

    def draw(self, count: int) -> Drawing:
        """Rows of a batch: `count`, or fewer where all others have had all their draws."""
        self.sampler.set_batch_size(count)
        quota = self.diet.shares
        rows, strata = self.sampler.draw()
        extra = self.sampler.drawn_weights
        if self.replays is not None and self.diet.max_replays is not None:
            rows, strata, extra = self._hold(rows, strata, extra, self.diet.max_replays)
        self.diet.count(strata)
        weight = extra
        own = self._own_weights(rows)
        if own is not None:
            weight = own if extra is None else own * extra
        if self.replays is not None and self._used_up() and self.diet.give_up():
            self._follow()
        return Drawing(rows, strata, weight, quota)

    def _own_weights(self, rows: Ints) -> F32 | None:
        if self._weights is not None:
            return self._weights.of(rows)
        return None if self.logs.weights is None else self.logs.weights[rows]

    def gather(self, rows: Ints, out: F32) -> None:
        """The packed rows last drawn (L, W), where they are not in memory."""
        if not isinstance(self.sampler, ChunkedSampler):
            raise TypeError("rows in memory are gathered from there")
        if len(rows) < self.sampler.batch_size or self._swapped:
            out[:] = self.logs.rows.numpy()[rows]
        else:
            self.sampler.gather(out)

    def update(self, rows: Ints, strata: Ints, td_abs: NDArray[Any]) -> None:
        """|TD error| (n,) of rows (n,) of these strata (n,) that were just learnt from."""
        self.sampler.update(rows, td_abs)
        if self.diet.observe(strata, td_abs):
            self._follow()

    def _follow(self) -> None:
        """The sampler and the weights take over the diet's shares."""
        self.sampler.set_shares(self.diet.shares)
        if self._weights is not None:
            self._weights.set_shares(self.diet.shares)

    def _hold(
        self, rows: Ints, strata: Ints, extra: F32 | None, cap: int
    ) -> tuple[Ints, Ints, F32 | None]:
        """Count the draws (L,), and replace those beyond the cap."""
        replays = self.replays
        if replays is None:
            raise RuntimeError("draws are not counted")
        np.add.at(replays, rows, 1)
        over = np.flatnonzero(replays[rows] > cap)
        self._swapped = bool(len(over))
        if not len(over):
            return rows, strata, extra
        rows, strata = rows.copy(), strata.copy()
        kept = np.ones(len(rows), np.bool_)
        if extra is not None:
            extra = extra.copy()
        for place in over.tolist():
            row, stratum = int(rows[place]), int(strata[place])
            if replays[row] <= cap:  # another place of this batch gave way
                continue
            replays[row] -= 1
            self.replaced[stratum] += 1
            found = self._instead(stratum, cap)
            if found is None:
                kept[place] = False
                continue
            rows[place], strata[place] = found
            replays[found[0]] += 1
            if extra is not None:
                extra[place] = 1.0
        return rows[kept], strata[kept], None if extra is None else extra[kept]

    def _instead(self, stratum: int, cap: int) -> tuple[int, int] | None:
        """A row that may still be drawn, and its stratum: of this one, else by the shares."""
        replays = self.replays
        if replays is None:
            return None
        others = self._rng.permutation(len(self.diet.shares))
        by_share = sorted(others.tolist(), key=lambda s: -self.diet.shares[s] * self._rng.random())
        for code in [stratum, *by_share]:
            members = self.logs.stratum_rows[code]
            free = members[replays[members] < cap]
            if len(free):
                return int(free[self._rng.integers(len(free))]), code
        return None

    def _used_up(self) -> bool:
        """Whether a stratum that has a share has no row left that may be drawn."""
        full = self.diet.drawn >= self._budget
        return bool(full.any()) and bool(self.diet.shares[full].any()) and self.diet.logs_share > 0

    def describe(self) -> list[dict[str, Any]]:
        """A row a stratum, for the run's table `shares`."""
        replays = self.replays
        rows = self.diet.describe()
        for index, (row, members) in enumerate(zip(rows, self.logs.stratum_rows, strict=True)):
            most = None if replays is None else int(replays[members].max(initial=0))
            row |= {"replays_max": most, "replaced_rows": int(self.replaced[index])}
        return rows

    def state_dict(self) -> dict[str, Any]:
        """Arrays and JSON values."""
        return {
            "diet": self.diet.state_dict(),
            "sampler": self.sampler.state_dict(),
            "replays": None if self.replays is None else self.replays.copy(),
            "replaced": self.replaced.copy(),
            "rng": generator_state(self._rng),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Puts the draws to come where `state_dict` found them."""
        self.sampler.load_state_dict(state["sampler"])
        self.diet.load_state_dict(state["diet"])
        if self.replays is not None:
            self.replays[:] = state["replays"]
        self.replaced = np.array(state["replaced"], np.int64)
        restore_generator(self._rng, state["rng"])
        self._follow()


def diet_of(panel: Panel, planned: PlannedDraws, logs_share: float | None) -> Diet:
    """The diet of a run that draws so much from a panel.

    Raises:
        MixtureError: see `Diet`.
    """
    mixture, sizes = panel.header.mixture, [len(rows) for rows in panel.stratum_rows()]
    names = [stratum.name.removeprefix(f"{stratum.source}/") for stratum in panel.strata]
    fed = [
        FedStratum(stratum.name, stratum.source, rule, size, stratum.episodes)
        for stratum, rule, size in zip(panel.strata, rules_of(mixture, names), sizes, strict=True)
    ]
    return Diet(mixture, fed, planned, logs_share=logs_share)


def _weights(panel: Panel) -> WeightsInForce | None:
    """The weights of a panel's rows, or None where none is corrected."""
    strata = panel.strata
    if all(stratum.correction == "none" for stratum in strata):
        return None
    meta, size = panel.meta, len(strata) // (1 + len(panel.header.others))
    outcome = None
    for index, stratum in enumerate(strata[:size]):
        if (name := outcome_column(stratum.name)) in meta.column_names:
            outcome = np.zeros((len(panel), size), np.float32) if outcome is None else outcome
            outcome[:, index] = meta[name].to_numpy()
    return WeightsInForce(
        panel.stratum_code,
        np.asarray(meta["state_code"].to_numpy(), np.int16),
        strata,
        1 + len(panel.header.others),
        panel.header.mixture.correction,
        outcome,
    )
