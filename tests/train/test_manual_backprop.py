"""The hand-written backward pass against autograd, in double precision, and its way into a run."""

from __future__ import annotations

import itertools
from typing import Any

import pytest
import torch
from torch import Tensor

from restock import native
from restock.train.dqn.config import parse_config
from restock.train.dqn.flat_adam import FlatParameters
from restock.train.dqn.learner import Learner
from restock.train.dqn.loss import (
    conservative_gradient,
    conservative_penalty,
    dqn_gradient,
    dqn_loss,
    margin_gradient,
    margin_penalty,
)
from restock.train.dqn.manual_backprop import ManualBackprop, update_path
from restock.train.dqn.network import QNetwork, clone

OBSERVATION, ACTIONS, BATCH = 7, 4, 12
BY_HAND = ["manual", "native"] if native.is_used() else ["manual"]
SHAPES = list(itertools.product([(3,), (16, 16), (5, 9, 4)], [False, True]))


def network(hidden: tuple[int, ...], layer_norm: bool, seed: int = 0) -> QNetwork:
    made = QNetwork(
        OBSERVATION,
        ACTIONS,
        hidden=hidden,
        layer_norm=layer_norm,
        generator=torch.Generator().manual_seed(seed),
    ).double()
    for index, parameter in enumerate(made.parameters()):  # LayerNorm begins at 1 and 0: not here
        with torch.no_grad():
            parameter.add_(normal(*parameter.shape, seed=50 + index), alpha=0.1)
    return made


def normal(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize(("hidden", "layer_norm"), SHAPES)
@pytest.mark.parametrize("batch", [1, 12])
def test_values_and_gradients_are_autograds(
    hidden: tuple[int, ...], layer_norm: bool, batch: int
) -> None:
    by_graph = network(hidden, layer_norm)
    by_hand = clone(by_graph)
    FlatParameters(by_hand, learns=True)
    backprop = ManualBackprop(by_hand)
    packed = normal(batch, 2 * OBSERVATION + 3, seed=1)  # observations are slices of wider rows
    now, after = packed[:, :OBSERVATION], packed[:, OBSERVATION : 2 * OBSERVATION]
    for seed in (2, 3):  # twice: nothing of the first pass is left in the second
        gradient = normal(batch, ACTIONS, seed=seed)
        expected = by_graph(now)
        by_graph.zero_grad()
        expected.backward(gradient)
        q, next_q = backprop.forward(now, after)
        backprop.backward(gradient)
        torch.testing.assert_close(q, expected.detach())
        torch.testing.assert_close(next_q, by_graph(after).detach())
        for name, parameter in by_hand.named_parameters():
            torch.testing.assert_close(
                parameter.grad, by_graph.get_parameter(name).grad, msg=f"gradient of {name}"
            )


def test_a_network_that_does_not_learn_is_evaluated_alone() -> None:
    still = clone(network((16, 16), layer_norm=True))
    FlatParameters(still, learns=False)
    backprop = ManualBackprop(still)
    (q,) = backprop.forward(normal(3, OBSERVATION, seed=0))
    torch.testing.assert_close(q, still(normal(3, OBSERVATION, seed=0)))
    with pytest.raises(RuntimeError, match="does not learn"):
        backprop.backward(q)


def test_a_dueling_network_is_refused() -> None:
    with pytest.raises(TypeError, match="plain"):
        ManualBackprop(QNetwork(OBSERVATION, ACTIONS, dueling=True))


def problem() -> tuple[Tensor, Tensor, Tensor]:
    """Action values with gradient (B, A), actions and targets (B,); errors on both sides of 1."""
    q = (2 * normal(BATCH, ACTIONS, seed=4)).requires_grad_()
    action = torch.arange(BATCH) % ACTIONS
    return q, action, normal(BATCH, seed=5)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("huber_delta", [0.3, 1.0])
def test_the_losses_slope(weighted: bool, huber_delta: float) -> None:
    q, action, target = problem()
    weight = normal(BATCH, seed=6).abs() if weighted else None
    loss = dqn_loss(q, action, target, weight=weight, huber_delta=huber_delta)
    (expected,) = torch.autograd.grad(loss.value, q)
    assert 0 < int((loss.td.abs() > huber_delta).sum()) < BATCH
    td = loss.td.clone()
    given = dqn_gradient(td, action, ACTIONS, weight=weight, huber_delta=huber_delta)
    torch.testing.assert_close(given, expected)
    assert torch.equal(td, loss.td)  # what is recorded is left as it is


@pytest.mark.parametrize("calibrated", [False, True])
def test_the_conservative_terms_slope(calibrated: bool) -> None:
    q, action, _ = problem()
    to_go = normal(BATCH, seed=7) if calibrated else None
    (expected,) = torch.autograd.grad(conservative_penalty(q, action, to_go), q)
    torch.testing.assert_close(conservative_gradient(q.detach(), action, to_go), expected)


def test_the_margins_slope() -> None:
    q, action, _ = problem()
    expert = torch.arange(BATCH) % 3 != 0
    (expected,) = torch.autograd.grad(margin_penalty(q, action, expert, 0.8), q)
    given = margin_gradient(q.detach(), action, expert, 0.8)
    torch.testing.assert_close(given, expected)
    assert bool((given == 0).all(dim=1)[expert].any())  # an expert's action that leads already
    assert bool((given != 0).any(dim=1)[expert].any())


def learner(path: Any, **sections: dict[str, Any]) -> Learner:
    document: dict[str, dict[str, Any]] = {"network": {"hidden": (16, 16)}, **sections}
    return Learner(parse_config(document, where="test"), OBSERVATION, ACTIONS, path=path)


def rows(seed: int) -> Tensor:
    packed = normal(BATCH, 2 * OBSERVATION + 3, seed=seed).float()
    packed[:, -3] = torch.arange(BATCH) % ACTIONS
    packed[:, -1] = 0.9 * (torch.arange(BATCH) % 5 != 0)
    return packed


@pytest.mark.parametrize(
    "sections",
    [
        {},
        {"loss": {"double": False}},
        {"loss": {"margin": 0.7}},
        {"optimizer": {"max_grad_norm": 0.05}},
        {"target": {"rule": "hard", "every": 3}},
        {"network": {"hidden": (8,), "layer_norm": False}},
    ],
    ids=str,
)
@pytest.mark.parametrize("path", BY_HAND)
def test_learning_by_hand_is_learning_by_autograd(path: str, sections: dict[str, Any]) -> None:
    given = {
        "weight": normal(BATCH, seed=8).abs().float(),
        "logged": 8,
        "conservative": 0.3,
        "return_to_go": normal(8, seed=9).float(),
        "expert": torch.arange(8) % 2 == 0 if "margin" in sections.get("loss", {}) else None,
    }
    by_hand, by_graph = learner(path, **sections), learner("autograd", **sections)
    for step in range(1, 9):
        ours, theirs = (each.update(rows(step), **given) for each in (by_hand, by_graph))  # type: ignore[arg-type]
        torch.testing.assert_close(ours.value, theirs.value.detach())
        torch.testing.assert_close(ours.td, theirs.td)
        torch.testing.assert_close(ours.q, theirs.q)
        for each in (by_hand, by_graph):
            each.target.after(step)
    one, two = by_hand.state_dict(), by_graph.state_dict()
    for part in ("network", "target_network", "policy_network"):
        torch.testing.assert_close(one[part], two[part], rtol=1e-4, atol=1e-5)


def test_the_way_is_chosen_by_the_network_and_the_device() -> None:
    def of(**network: Any) -> str:
        return update_path(parse_config({"network": network}, where="test").network, "cpu")

    assert of() == of(layer_norm=False, hidden=(8,)) == BY_HAND[-1]
    assert of(dueling=True) == "autograd"
    assert update_path(parse_config({}, where="test").network, "cuda") == "manual"
    assert learner(None).path == BY_HAND[-1]


@pytest.mark.parametrize("path", BY_HAND)
def test_a_learner_that_is_restored_learns_on_as_it_would_have(path: str) -> None:
    first = learner(path)
    for step in range(1, 4):
        first.update(rows(step))
    state = first.state_dict()
    # Moments are kept a parameter: in shape and order as an optimizer of each would.
    shapes = [parameter.shape for parameter in first.network.parameters()]
    assert [entry["exp_avg"].shape for entry in state["optimizer"]["moments"].values()] == shapes
    second = learner(path, seed=5)  # type: ignore[arg-type]
    second.load_state_dict(state)
    for each in (first, second):
        each.update(rows(9))
    for name, value in first.network.state_dict().items():
        assert torch.equal(value, second.network.state_dict()[name]), name


def test_flat_parameters_are_the_networks_own() -> None:
    held = network((5, 9, 4), layer_norm=True)
    before = {name: value.clone() for name, value in held.state_dict().items()}
    flat = FlatParameters(held, learns=True)
    for name, value in held.state_dict().items():
        assert torch.equal(value, before[name])
        assert value.data_ptr() % 64 == 0  # aligned, so that sums come out the same in any process
    flat.values.add_(1.0)
    for name, value in held.state_dict().items():
        torch.testing.assert_close(value, before[name] + 1)
    held.load_state_dict(before)
    again = flat.flat_of(flat.views(flat.values))
    assert torch.equal(
        torch.cat([v.flatten() for v in flat.views(again)]),
        torch.cat([v.flatten() for v in before.values()]),
    )
