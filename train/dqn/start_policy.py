"""What a run may begin to drive with: its values as they are, filtered, or led by proposals.

Values that were learnt from logs alone are bold where the logs are thin. A teacher's filter keeps
them to what it finds plausible; led by what the navigation stack proposes they decide only where
the teacher would not do as it says.
"""

from __future__ import annotations

from typing import Annotated, Any

import torch
from msgspec import Meta
from numpy.typing import NDArray
from torch import Tensor

from restock.toml import Checked
from restock.train.dqn.behaviour import FilteredNetwork, PolicyNetwork, ProposedNetwork
from restock.train.dqn.network import QNetwork


class StartPolicy(Checked, frozen=True):
    """How a policy is made of a run's networks."""

    ratio: Annotated[float, Meta(gt=0, le=1)] | None = None  # of the filter; None: all actions
    proposed: bool = False  # as navigation proposes, where that is plausible

    @property
    def name(self) -> str:
        """`values`, `filtered 0.3`, `cloned`, `proposed`, `proposed, filtered 0.3`."""
        if self.ratio is None:
            return "proposed" if self.proposed else "values"
        inner = "cloned" if self.ratio == 1 else f"filtered {self.ratio:g}"
        return f"proposed, {inner}" if self.proposed else inner


def start_network(
    start: StartPolicy, policy: PolicyNetwork, actions: NDArray[Any]
) -> PolicyNetwork:
    """Return the policy that `start` names; it shares the networks of `policy`.

    `actions` are (A, 2) speed and yaw rate, in units of the fastest of each.
    """
    inner = policy.inner if isinstance(policy, ProposedNetwork) else policy
    behaviour = inner.behaviour if isinstance(inner, FilteredNetwork) else None
    values = inner.values if isinstance(inner, FilteredNetwork) else inner
    made: QNetwork | FilteredNetwork = values
    if start.ratio is not None:
        if behaviour is None:
            raise ValueError("a filter needs a behaviour network")
        made = FilteredNetwork(values, behaviour, torch.tensor(start.ratio, device=_device(values)))
    if not start.proposed:
        return made
    return ProposedNetwork(
        made, torch.as_tensor(actions, dtype=torch.float32, device=_device(made))
    )


def _device(network: torch.nn.Module) -> torch.device:
    parameter: Tensor = next(network.parameters())
    return parameter.device


__all__ = ["StartPolicy", "start_network"]
