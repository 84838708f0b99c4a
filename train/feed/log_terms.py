"""What the terms for logged rows need to know of each: whose action it was, and what came of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from restock.errors import ConfigError
from restock.replay.mixture.packed_row import Ints
from restock.train.dqn.config import LossConfig
from restock.train.feed.batches import Logs


@dataclass(frozen=True)
class LogTerms:
    """Per row of the panel, on the learner's device; None where no term asks."""

    expert: Tensor | None  # (n,) bool: DQfD's margin applies
    return_to_go: Tensor | None  # (n,) float32: Cal-QL's floor

    @classmethod
    def of(cls, loss: LossConfig, logs: Logs | None, device: torch.device) -> LogTerms:
        """What `loss` asks of these logs.

        Raises:
            ConfigError: it names a behaviour policy or stratum that they do not have, or there are
                none.
            PanelError: Cal-QL without a return-to-go in the panel.
        """
        if logs is None:
            if loss.margin or loss.calibrated:
                raise ConfigError(
                    "loss.margin and loss.calibrated are about logged rows, and there are none",
                    remedy="give --panel, or leave them out",
                )
            return cls(None, None)
        expert = to_go = None
        if loss.margin:
            expert = torch.from_numpy(_expert(loss, logs)).to(device)
        if loss.calibrated:
            if logs.panel is None:
                raise ConfigError("loss.calibrated needs logs from a panel")
            to_go = torch.from_numpy(np.array(logs.panel.return_to_go)).to(device)
        return cls(expert, to_go)

    def rows(self, log_rows: Ints) -> tuple[Tensor | None, Tensor | None]:
        """`expert` and `return_to_go` of some rows of the panel."""
        if self.expert is None and self.return_to_go is None:
            return None, None
        index = torch.from_numpy(log_rows)
        return (
            None if self.expert is None else self.expert[index.to(self.expert.device)],
            None
            if self.return_to_go is None
            else self.return_to_go[index.to(self.return_to_go.device)],
        )


def _expert(loss: LossConfig, logs: Logs) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """The rows, (n,), of `margin_policies` in `margin_strata`."""
    policy = logs.behaviour_policy
    _known("loss.margin_policies", loss.margin_policies, policy.names)
    _known("loss.margin_strata", loss.margin_strata, logs.strata)
    chosen = np.isin(policy.codes, [policy.names.index(name) for name in loss.margin_policies])
    if loss.margin_strata:
        inside = np.zeros(len(chosen), np.bool_)
        for name, rows in zip(logs.strata, logs.stratum_rows, strict=True):
            inside[rows] = name in loss.margin_strata
        chosen &= inside
    return chosen


def _known(key: str, asked: tuple[str, ...], known: list[str]) -> None:
    for name in asked:
        if name not in known:
            raise ConfigError(
                f"{key}: the logs have no {name!r}", remedy=f"they have {', '.join(known)}"
            )


__all__ = ["LogTerms"]
