"""The compiled update: against autograd in double precision, against PyTorch's operations to the
bit where they are the same, with and without AVX-512, and what it refuses."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from restock import native
from restock.train.dqn.config import parse_config
from restock.train.dqn.flat_adam import FlatParameters
from restock.train.dqn.loss import dqn_gradient, dqn_loss, td_target
from restock.train.dqn.manual_backprop import ManualBackprop, update_path
from restock.train.dqn.native_backprop import NativeBackprop, native_td_loss
from restock.train.dqn.network import QNetwork, clone

compiled = pytest.mark.skipif(not native.is_used(), reason=f"native code is {native.state()}")
OBSERVATION, ACTIONS = 7, 4
SHAPES = [(3,), (16, 16), (40, 33, 18), (64, 32)]


def normal(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def network(hidden: tuple[int, ...], layer_norm: bool) -> QNetwork:
    generator = torch.Generator().manual_seed(0)
    made = QNetwork(OBSERVATION, ACTIONS, hidden=hidden, layer_norm=layer_norm, generator=generator)
    for index, parameter in enumerate(made.parameters()):  # LayerNorm begins at 1 and 0: not here
        with torch.no_grad():
            parameter.add_(normal(*parameter.shape, seed=50 + index), alpha=0.1)
    return made


def made_native(held: QNetwork, *, wide: bool = True) -> NativeBackprop:
    flat = FlatParameters(held, learns=True)
    return NativeBackprop(held, flat.values, flat.gradient, wide=wide)


@compiled
@pytest.mark.parametrize("hidden", SHAPES)
@pytest.mark.parametrize("layer_norm", [False, True])
@pytest.mark.parametrize("batch", [1, 37])
def test_values_and_gradients_are_autograds(
    hidden: tuple[int, ...], layer_norm: bool, batch: int
) -> None:
    """Of the same network in double precision; and the same bits, how wide vectors ever are."""
    held = network(hidden, layer_norm)
    exact = clone(held).double().requires_grad_()
    narrow = clone(held)
    both = [(held, made_native(held)), (narrow, made_native(narrow, wide=False))]
    packed = normal(batch, 2 * OBSERVATION + 3, seed=1)  # observations are slices of wider rows
    now, after = packed[:, :OBSERVATION], packed[:, OBSERVATION : 2 * OBSERVATION]
    for seed in (2, 3):  # twice: nothing of the first pass is left in the second
        gradient = normal(batch, ACTIONS, seed=seed)
        expected = exact(now.double())
        exact.zero_grad()
        expected.backward(gradient.double())
        found = []
        for made, backprop in both:
            q, next_q = backprop.forward(now, after)
            backprop.backward(gradient)
            torch.testing.assert_close(q.double(), expected.detach(), rtol=1e-4, atol=1e-5)
            torch.testing.assert_close(
                next_q.double(), exact(after.double()).detach(), rtol=1e-4, atol=1e-5
            )
            for name, parameter in made.named_parameters():
                wanted = exact.get_parameter(name).grad
                assert parameter.grad is not None
                torch.testing.assert_close(
                    parameter.grad.double(), wanted, rtol=1e-4, atol=1e-4, msg=name
                )
            found.append([q, next_q, *(one.grad for one in made.parameters())])
        for wide, as_narrow in zip(*found, strict=True):
            assert torch.equal(wide, as_narrow)


@compiled
@pytest.mark.parametrize("double", [False, True])
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("filtered", [False, True])
def test_the_loss_is_that_of_pytorchs_operations(
    double: bool, weighted: bool, filtered: bool
) -> None:
    q, slow, fast = (3 * normal(21, ACTIONS, seed=seed) for seed in (1, 2, 3))
    fast[4, 2] = slow[4, 2] = torch.nan  # the largest of all, as PyTorch has it
    tail = normal(21, 9, seed=4)[:, 6:]
    tail[:, 0] = torch.arange(21) % ACTIONS
    action = tail[:, 0].long()
    weight = normal(21, seed=5).abs() if weighted else None
    plausible = normal(21, ACTIONS, seed=6) > -0.5 if filtered else None
    if plausible is not None:
        plausible[7] = False  # none at all: the first
    chooses = fast if double else None
    target = td_target(tail[:, 1], tail[:, 2], slow, chooses, plausible)
    wanted = dqn_loss(q, action, target, weight=weight, huber_delta=1.0)
    slope = dqn_gradient(wanted.td, action, ACTIONS, weight=weight, huber_delta=1.0)
    loss, gradient = native_td_loss(
        q, slow, chooses, plausible, tail, weight=weight, huber_delta=1.0
    )
    assert torch.isnan(wanted.td).sum() <= 1
    for ours, theirs in ((loss.td, wanted.td), (loss.q, wanted.q), (gradient, slope)):
        np.testing.assert_array_equal(ours.numpy(), theirs.numpy())
    torch.testing.assert_close(loss.value, wanted.value, equal_nan=True)


@compiled
def test_a_network_that_does_not_learn_is_evaluated_alone() -> None:
    still = clone(network((16, 16), layer_norm=True))
    backprop = NativeBackprop(still, FlatParameters(still, learns=False).values)
    (q,) = backprop.forward(normal(3, OBSERVATION, seed=0))
    torch.testing.assert_close(q, still(normal(3, OBSERVATION, seed=0)))
    with pytest.raises(RuntimeError, match="does not learn"):
        backprop.backward(q)


@compiled
def test_no_rows_have_no_gradient() -> None:
    held = network((16, 16), layer_norm=True)
    backprop = made_native(held)
    (q,) = backprop.forward(normal(0, OBSERVATION, seed=0))
    backprop.backward(q)
    assert all(not bool(one.grad.any()) for one in held.parameters() if one.grad is not None)


@compiled
def test_a_dueling_network_is_refused() -> None:
    with pytest.raises(TypeError, match="plain"):
        NativeBackprop(QNetwork(OBSERVATION, ACTIONS, dueling=True), torch.zeros(1))


def floats(*shape: int) -> np.ndarray:
    return np.zeros(shape, np.float32)


@compiled
def test_what_does_not_fit_is_refused() -> None:
    """Sizes, types, strides: an error, never a read or a write beside the array."""
    module = native.compiled
    size = 7 * 16 + 16 + 4 * 16 + 16  # of (7, 16, 4), without LayerNorm
    made = module.Network((7, 16, 4), -1.0, floats(size), floats(size))
    fixed = floats(size)
    fixed.flags.writeable = False
    nets: list[tuple[Any, ...]] = [
        ((7, 4), -1.0, floats(size), None),
        ((7, 0, 4), -1.0, floats(size), None),
        ((7, "16", 4), -1.0, floats(size), None),
        ((7, 1 << 40, 4), -1.0, floats(size), None),
        ((1,) * 100, -1.0, floats(size), None),
        ((7, 16, 4), -1.0, floats(size + 1), None),
        ((7, 16, 4), 1e-5, floats(size), None),
        ((7, 16, 4), -1.0, floats(size), floats(size - 1)),
        ((7, 16, 4), -1.0, floats(2 * size)[::2], None),
        ((7, 16, 4), -1.0, np.zeros(size), None),
        ((7, 16, 4), -1.0, floats(size), fixed),
        ((7, 16, 4), -1.0, "values", None),
    ]
    for words in nets:
        with pytest.raises((TypeError, ValueError, BufferError)):
            module.Network(*words)
    with pytest.raises(RuntimeError, match="before"):
        made.__init__((7, 16, 4), -1.0, floats(size), None)  # type: ignore[misc]
    with pytest.raises(RuntimeError, match="not initialised"):
        module.Network.__new__(module.Network).forward((floats(3, 7),), floats(3, 4))
    with pytest.raises(ValueError, match="gradient"):
        made.backward(floats(3, 4))  # before any forward pass
    for inputs, out in [
        ((floats(3, 7),), floats(3, 5)),
        ((floats(3, 7),), floats(4, 4)),
        ((floats(3, 6),), floats(3, 4)),
        ((floats(3, 7), floats(2, 7)), floats(6, 4)),
        ((), floats(3, 4)),
        ((floats(7, 3).T,), floats(3, 4)),
        ((floats(3, 7)[::-1],), floats(3, 4)),
        ((np.zeros((3, 7)),), floats(3, 4)),
        ((floats(3, 7),), floats(3, 8)[:, ::2]),
        ((None,), floats(3, 4)),
    ]:
        with pytest.raises((TypeError, ValueError)):
            made.forward(inputs, out)
    made.forward((floats(3, 7), floats(3, 7)), floats(6, 4))
    for gradient in (floats(6, 4), floats(3, 3), floats(12), floats(3, 8)[:, ::2]):
        with pytest.raises((TypeError, ValueError)):
            made.backward(gradient)
    made.backward(floats(3, 4))
    sound: list[Any] = [floats(3, 4), floats(3, 4), floats(3, 4), None, floats(3, 3), None, 1.0]
    sound += [floats(3, 4), floats(7)]
    module.td_loss(*sound)
    wrong = {0: floats(0, 4), 1: floats(3, 3), 2: floats(2, 4), 3: floats(3, 4), 4: floats(3, 2)}
    for at, value in {**wrong, 5: floats(4), 7: floats(4, 4), 8: floats(6)}.items():
        with pytest.raises((TypeError, ValueError)):
            module.td_loss(*sound[:at], value, *sound[at + 1 :])
    for action in (4, -1, np.nan, np.inf):
        sound[4] = floats(3, 3)
        sound[4][1, 0] = action
        with pytest.raises(IndexError, match="row 1"):
            module.td_loss(*sound)
    settings = (0.9, 0.999, 1e-3, 1.0, 1e-8, 0.5)
    module.adam(*(floats(5) for _ in range(5)), settings)
    for at in range(5):
        parts = [floats(5 + (index == at)) for index in range(5)]
        with pytest.raises(ValueError, match="shape"):
            module.adam(*parts, settings)


@compiled
def test_the_compiled_way_is_that_of_one_thread() -> None:
    plain = parse_config({}, where="test").network
    assert update_path(plain, "cpu") == "native"
    assert update_path(plain, "cpu", threads=2) == "manual"
    assert update_path(plain, "cuda") == "manual"


@compiled
@pytest.mark.parametrize(
    ("value", "used"),
    [("0", False), ("no", False), ("False", False), ("OFF", False), ("1", True), ("", True)],
)
def test_the_usual_words_switch_it_off(
    value: str, used: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(native.SWITCH, value)
    assert native.is_used() == used
    assert native.state().startswith("in use") == used


@pytest.mark.parametrize("way", ["asked for", "not compiled"])
def test_without_it_pytorch_does_the_work(way: str, monkeypatch: pytest.MonkeyPatch) -> None:
    absent = "sys.modules['restock._native'] = None" if way == "not compiled" else ""
    monkeypatch.setenv(native.SWITCH, "0" if way == "asked for" else "1")
    probe = f"""
import sys
{absent}
from restock import native
from restock.cli import main
from restock.train.dqn.config import parse_config
from restock.train.dqn.learner import Learner

assert not native.is_used()
print(Learner(parse_config({{}}, where="test"), 7, 4).path, flush=True)
main(["--version"])
"""
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    path, _, told = done.stdout.splitlines()
    assert path == "manual"
    assert told.startswith("native code not in use: ")


@compiled
def test_learning_at_twice_the_batch_is_what_pytorch_makes_of_it() -> None:
    """Memory grows with the batch, and a smaller one after it uses its beginning."""
    held = network((48, 48), layer_norm=True)
    theirs = clone(held)
    FlatParameters(theirs, learns=True)
    manual, ours = ManualBackprop(theirs), made_native(held)
    for rows in (8, 64, 16):
        given, gradient = normal(rows, OBSERVATION, seed=rows), normal(rows, ACTIONS, seed=1)
        torch.testing.assert_close(ours.forward(given)[0], manual.forward(given)[0])
        ours.backward(gradient)
        manual.backward(gradient)
        for one, other in zip(held.parameters(), theirs.parameters(), strict=True):
            torch.testing.assert_close(one.grad, other.grad, rtol=1e-4, atol=1e-4)
