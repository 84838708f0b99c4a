"""QR-DQN (arXiv:1710.10044) as an algorithm of your own, trained by `restock train`.

    cd docs/examples && restock train --panel panel/ --set loss.algorithm=qr_dqn:QRDQN

The network gives N quantiles of the return of each action. Their mean is the action's value, which
the twin, evaluation and ONNX use. The target of a row is the quantiles of its best next action.
"""

import torch
from torch import Tensor

from restock.train import Loss, QNetwork, TrainingBatch

QUANTILES = 32


class QuantileNetwork(QNetwork):
    """Observations (B, D) to quantiles (B, A, N), or to their means (B, A)."""

    def __init__(self, observation_size: int, actions: int, **options) -> None:
        super().__init__(observation_size, actions * QUANTILES, **options)
        self.actions = actions

    def quantiles(self, observation: Tensor) -> Tensor:
        """Return the quantiles (B, A, N) of the return of each action."""
        return super().forward(observation).unflatten(1, (self.actions, QUANTILES))

    def forward(self, observation: Tensor) -> Tensor:
        """Return action values (B, A)."""
        return self.quantiles(observation).mean(dim=2)


class QRDQN:
    """Quantile regression, with the next action chosen by the online network."""

    def __init__(self, settings) -> None:
        self.settings = settings

    def make_network(self, config, observation_size, actions, generator=None) -> QuantileNetwork:
        """Return the network of a run's `[network]` settings."""
        return QuantileNetwork(
            observation_size,
            actions,
            hidden=config.hidden,
            layer_norm=config.layer_norm,
            generator=generator,
        )

    def loss(self, network: QuantileNetwork, target: QuantileNetwork, batch: TrainingBatch) -> Loss:
        """Return the quantile Huber loss of a batch, equation 10 of the paper."""
        wanted = self._target_quantiles(network, target, batch)  # (B, N)
        found = _of_action(network.quantiles(batch.observation), batch.action)  # (B, N)
        error = wanted.unsqueeze(1) - found.unsqueeze(2)  # (B, N found, N wanted)
        delta = self.settings.huber_delta
        size = error.abs()
        huber = torch.where(size <= delta, error**2 / 2, delta * (size - delta / 2))
        middle = (torch.arange(QUANTILES, device=error.device) + 0.5) / QUANTILES
        slope = (middle[:, None] - (error.detach() < 0).float()).abs()
        each = (slope * huber / delta).mean(dim=2).sum(dim=1)
        value = each.mean() if batch.weight is None else (each * batch.weight).mean()
        q = found.detach().mean(dim=1)
        return Loss(value, td=q - wanted.mean(dim=1), q=q)

    @torch.no_grad()
    def _target_quantiles(
        self, network: QuantileNetwork, target: QuantileNetwork, batch: TrainingBatch
    ) -> Tensor:
        chooses = network(batch.next_observation)
        if batch.preference is not None:  # a teacher's
            chooses = chooses + batch.preference
        following = _of_action(target.quantiles(batch.next_observation), chooses.argmax(dim=1))
        return batch.reward.unsqueeze(1) + batch.discount.unsqueeze(1) * following


def _of_action(quantiles: Tensor, action: Tensor) -> Tensor:
    """Return the quantiles (B, N) of one action of each row."""
    return quantiles[torch.arange(len(action), device=action.device), action]
