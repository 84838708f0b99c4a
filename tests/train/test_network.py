"""The Q network: shapes, LayerNorm, seeded initialisation."""

import torch

from restock.train.dqn.network import QNetwork, clone


def seeded(seed: int = 0, **options: object) -> QNetwork:
    return QNetwork(5, 3, hidden=(8, 8), generator=torch.Generator().manual_seed(seed), **options)  # type: ignore[arg-type]


def test_the_seed_decides_the_weights_whatever_the_global_state() -> None:
    torch.manual_seed(1)
    first = seeded(7).state_dict()
    torch.manual_seed(2)
    second = seeded(7).state_dict()
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert not torch.equal(first["advantage.weight"], seeded(8).state_dict()["advantage.weight"])


def test_layer_norm_makes_features_independent_of_scale() -> None:
    network = seeded()
    observation = torch.randn(6, 5, generator=torch.Generator().manual_seed(0))
    before = network(observation)
    with torch.no_grad():
        network.body[0].weight.mul_(100)
        network.body[0].bias.mul_(100)
    assert torch.allclose(network(observation), before, atol=1e-3)

    plain = seeded(layer_norm=False)
    before = plain(observation)
    with torch.no_grad():
        plain.body[0].weight.mul_(100)
        plain.body[0].bias.mul_(100)
    assert not torch.allclose(plain(observation), before, atol=1e-3)


def test_a_clone_is_apart_and_takes_no_gradients() -> None:
    network = seeded()
    copied = clone(network)
    with torch.no_grad():
        network.advantage.bias.add_(1.0)
    assert not torch.equal(network.advantage.bias, copied.advantage.bias)
    assert not any(parameter.requires_grad for parameter in copied.parameters())
