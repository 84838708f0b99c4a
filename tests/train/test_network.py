"""Check LayerNorm in the Q network, and clones without gradients."""

import pytest
import torch

from restock.train.dqn.network import QNetwork, clone


@pytest.mark.parametrize("layer_norm", [True, False])
def test_layer_norm_makes_features_independent_of_scale(layer_norm: bool) -> None:
    generator = torch.Generator().manual_seed(0)
    network = QNetwork(5, 3, hidden=(8, 8), layer_norm=layer_norm, generator=generator)
    observation = torch.randn(6, 5, generator=generator)
    before = network(observation)
    with torch.no_grad():
        network.body[0].weight.mul_(100)
        network.body[0].bias.mul_(100)
    assert torch.allclose(network(observation), before, atol=1e-3) == layer_norm


def test_cloned_network_has_no_gradients() -> None:
    network = QNetwork(5, 3, hidden=(8,))
    assert all(parameter.requires_grad for parameter in network.parameters())
    assert not any(parameter.requires_grad for parameter in clone(network).parameters())
