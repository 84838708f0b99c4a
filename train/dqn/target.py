"""The target network's clock: how the slow copy follows the online network.

Two clocks run in DQN: the online network moves at every update, the target network by its own
rule. The rule decides how old the values are that the critic learns from, so it is a typed value
that the run's config, metrics and checkpoints all carry.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any, ClassVar

import msgspec
import torch
from msgspec import Meta

from restock.state import Stateful
from restock.toml import Checked


class Hard(Checked, frozen=True, tag_field="rule", tag="hard"):
    """Copy the online network at every `every`-th update (arXiv:1312.5602)."""

    every: Annotated[int, Meta(ge=1)] = 1000

    @property
    def effective_lag(self) -> float:
        """The mean age of the target in updates: C / 2."""
        return self.every / 2

    def syncs_at(self, gradient_step: int) -> bool:
        """Return whether the target is copied after update number `gradient_step` (from 1)."""
        return gradient_step % self.every == 0

    def __str__(self) -> str:
        return f"hard every {self.every}"


class Polyak(Checked, frozen=True, tag_field="rule", tag="polyak"):
    """target += tau * (online - target), after every update (arXiv:1509.02971)."""

    tau: Annotated[float, Meta(gt=0, le=1)] = 0.005

    @property
    def effective_lag(self) -> float:
        """The mean age of what the target holds, in updates: 1 / tau."""
        return 1 / self.tau

    def syncs_at(self, gradient_step: int) -> bool:
        return True

    def __str__(self) -> str:
        return f"polyak tau {self.tau:g}"


TargetRule = Hard | Polyak


def describe(rule: TargetRule) -> dict[str, Any]:
    """Return the rule as the run's config states it."""
    return {**msgspec.to_builtins(rule), "effective_lag_updates": rule.effective_lag}


class TargetUpdate(Stateful):
    """Applies a rule to the parameters of a pair of networks, in the same order."""

    STATE: ClassVar[tuple[str, ...]] = ("last_sync",)

    def __init__(
        self, rule: TargetRule, online: Iterable[torch.Tensor], target: Iterable[torch.Tensor]
    ) -> None:
        self.rule = rule
        self.last_sync = 0  # the update after which the target last moved
        self._online = list(online)
        self._target = list(target)

    @torch.no_grad()
    def after(self, gradient_step: int) -> bool:
        """Call after update number `gradient_step` (from 1); returns whether the target moved.

        It does not again for an update that it has followed, as in `Learner.move`.
        """
        if gradient_step == self.last_sync or not self.rule.syncs_at(gradient_step):
            return False
        self.pull()
        self.last_sync = gradient_step
        return True

    @torch.no_grad()
    def pull(self) -> None:
        """Move the target as the rule does when it is due."""
        for slow, fast in zip(self._target, self._online, strict=True):
            if isinstance(self.rule, Polyak):
                slow.lerp_(fast, self.rule.tau)
            else:
                slow.copy_(fast)

    @torch.no_grad()
    def distance(self) -> float:
        """|online - target| / |online|, over all parameters together (Euclidean)."""
        apart = torch._foreach_norm(torch._foreach_sub(self._online, self._target))
        size = torch._foreach_norm(self._online)
        total = torch.stack(list(size)).norm()
        return float(torch.stack(list(apart)).norm() / total.clamp_min(1e-12))


@torch.no_grad()
def value_lag(online_q: torch.Tensor, target_q: torch.Tensor) -> float:
    """mean |Q - Q_target| / mean |Q| over values (B, A): how far apart the two clocks are."""
    return float((online_q - target_q).abs().mean() / online_q.abs().mean().clamp_min(1e-12))
