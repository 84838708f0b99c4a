"""The sources of a mixture's batches: logs, other stores, and fresh rows, by share or schedule."""

from __future__ import annotations

import itertools

import msgspec

from restock.replay.mixture.schedules import Portion, knots, value_at


def check(ok: bool, message: str) -> None:
    """Raises ValueError, which msgspec turns into an error with the place in the file."""
    if not ok:
        raise ValueError(message)


def _check_portion(name: str, share: Portion) -> None:
    if isinstance(share, int | float):
        check(0 <= share <= 1, f"share of {name} must be in [0, 1], got {share:g}")


class OtherStore(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One more store that batches are drawn from, with the same strata and shares of its own."""

    name: str  # its strata are called `name/stratum`
    path: str  # as it is, or from the folder of the mixture's file
    share: Portion  # of a batch
    version: int | None = None  # of the store; the newest, which the panel then pins

    def __post_init__(self) -> None:
        check(bool(self.name) and "/" not in self.name, f"no name for a store: {self.name!r}")
        check(self.name not in ("logs", "fresh"), f"a store cannot be called {self.name!r}: taken")
        _check_portion(f"the store {self.name!r}", self.share)


class Sources(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Shares of an online batch by source, numbers or schedules; what is left is fresh."""

    logs: Portion = 0.5
    fresh: float | None = None  # default: what logs and stores leave, at every step
    stores: tuple[OtherStore, ...] = ()

    def __post_init__(self) -> None:
        portions = [self.logs, *(store.share for store in self.stores)]
        _check_portion("logs", self.logs)
        names = [store.name for store in self.stores]
        check(len(set(names)) == len(names), f"stores named twice: {sorted(names)}")
        if self.fresh is not None:
            fixed = [portion for portion in portions if isinstance(portion, int | float)]
            check(
                len(fixed) == len(portions),
                "sources: leave `fresh` out beside a schedule: it gets what is left",
            )
            total = sum(fixed) + self.fresh
            check(
                self.fresh >= 0 and abs(total - 1) < 1e-6,
                f"sources must sum to 1, got {total:g}",
            )
        bends = sorted({0, *(step for portion in portions for step in knots(portion))})
        # Between two bends a cosine can lie above the line that joins them.
        fine = [a + (b - a) * i / 16 for a, b in itertools.pairwise(bends) for i in range(16)]
        totals = [
            sum(value_at(portion, step) for portion in portions) for step in [*fine, bends[-1]]
        ]
        check(max(totals) <= 1 + 1e-6, f"sources sum to {max(totals):g} at some step, above 1")
        check(
            value_at(self.logs, 0) > 0,
            "sources.logs must be above 0 at step 0: the offline phase draws from it",
        )

    @property
    def parts(self) -> dict[str, Portion]:
        """The share of a batch of each source that is not fresh."""
        return {"logs": self.logs, **{store.name: store.share for store in self.stores}}

    @property
    def last_bend(self) -> int:
        """The environment step at which the last schedule ends, 0 without one."""
        return max((step for part in self.parts.values() for step in knots(part)), default=0)
