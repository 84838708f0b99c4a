"""Compare the compiled update with autograd in double precision, with and without AVX-512."""

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from restock import native
from restock.train.dqn import behaviour
from restock.train.dqn.config import parse_config
from restock.train.dqn.learner import Learner
from restock.train.dqn.network import FlatParameters, Kernel, QNetwork, clone, update_path

compiled = pytest.mark.skipif(not native.IS_USED, reason=f"native code is {native.state()}")
OBSERVATION, ACTIONS = 7, 4
SHAPES = [(3,), (16, 16), (40, 33, 18), (64, 32)]


def normal(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def network(hidden: tuple[int, ...], layer_norm: bool) -> QNetwork:
    generator = torch.Generator().manual_seed(0)
    made = QNetwork(OBSERVATION, ACTIONS, hidden=hidden, layer_norm=layer_norm, generator=generator)
    for index, parameter in enumerate(made.parameters()):  # LayerNorm starts at 1 and 0
        with torch.no_grad():
            parameter.add_(normal(*parameter.shape, seed=50 + index), alpha=0.1)
    return made


def make_kernel(held: QNetwork, *, wide: bool = True) -> Kernel:
    flat = FlatParameters(held, learns=True)
    return Kernel(held, flat.values, flat.gradient, wide=wide)


@compiled
@pytest.mark.parametrize("hidden", SHAPES)
@pytest.mark.parametrize("layer_norm", [False, True])
@pytest.mark.parametrize("batch", [1, 37])
def test_values_and_gradients_match_autograd(hidden, layer_norm, batch):
    """Compare with double precision, and bit for bit between vector widths."""
    held = network(hidden, layer_norm)
    exact = clone(held).double().requires_grad_()
    narrow = clone(held)
    both = [(held, make_kernel(held)), (narrow, make_kernel(narrow, wide=False))]
    packed = normal(batch, 2 * OBSERVATION + 3, seed=1)  # strided: slices of wider rows
    now, after = packed[:, :OBSERVATION], packed[:, OBSERVATION : 2 * OBSERVATION]
    for seed in (2, 3):  # twice, to check that no state is left
        gradient = normal(batch, ACTIONS, seed=seed)
        expected = exact(now.double())
        exact.zero_grad()
        expected.backward(gradient.double())
        found = []
        for made, backprop in both:
            backprop.zero_grad()
            next_q = backprop(after).detach()
            q = backprop(now)
            q.backward(gradient)
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
def test_frozen_network_is_evaluated_without_gradients() -> None:
    still = clone(network((16, 16), layer_norm=True))
    backprop = Kernel(still, FlatParameters(still, learns=False).values)
    q = backprop(normal(3, OBSERVATION, seed=0))
    torch.testing.assert_close(q, still(normal(3, OBSERVATION, seed=0)))
    assert not q.requires_grad


def floats(*shape: int) -> np.ndarray:
    return np.zeros(shape, np.float32)


@compiled
def test_arrays_of_wrong_shape_or_dtype_are_rejected() -> None:
    """Check sizes, types and strides: none may cause reads or writes outside the arrays."""
    module = native.compiled
    size = 7 * 16 + 16 + 4 * 16 + 16  # parameters of (7, 16, 4) without LayerNorm
    fixed = floats(size)
    fixed.flags.writeable = False
    good: tuple[Any, ...] = ((7, 16, 4), -1.0, floats(size), floats(size))
    for at, wrong in [
        *((0, shape) for shape in ((7, 4), (7, 0, 4), (7, "16", 4), (7, 1 << 40, 4), (1,) * 100)),
        *((2, values) for values in (floats(size + 1), floats(2 * size)[::2], np.zeros(size))),
        (2, "values"),
        *((3, gradient) for gradient in (floats(size - 1), fixed)),
    ]:
        with pytest.raises((TypeError, ValueError, BufferError)):
            module.Network(*good[:at], wrong, *good[at + 1 :])
    made = module.Network(*good)
    with pytest.raises(ValueError, match="gradient"):
        made.backward(floats(3, 4))  # before any forward pass
    for inputs, out in [
        ((floats(3, 7),), floats(3, 5)),
        ((floats(3, 6),), floats(3, 4)),
        ((floats(3, 7), floats(2, 7)), floats(6, 4)),
        ((), floats(3, 4)),
        ((floats(7, 3).T,), floats(3, 4)),
        ((np.zeros((3, 7)),), floats(3, 4)),
        ((floats(3, 7),), floats(3, 8)[:, ::2]),
    ]:
        with pytest.raises((TypeError, ValueError)):
            made.forward(inputs, out)
    made.forward((floats(3, 7), floats(3, 7)), floats(6, 4))
    for gradient in (floats(6, 4), floats(3, 3), floats(3, 8)[:, ::2]):
        with pytest.raises((TypeError, ValueError)):
            made.backward(gradient)
    for at in range(5):
        parts = [floats(5 + (index == at)) for index in range(5)]
        with pytest.raises(ValueError, match="shape"):
            module.adam(*parts, (0.9, 0.999, 1e-3, 1.0, 1e-8, 0.5))


@compiled
def test_compiled_path_needs_cpu_and_one_thread() -> None:
    assert update_path("cpu") == "native"
    assert update_path("cpu", threads=2) == "autograd"
    assert update_path("cuda") == "autograd"


@compiled
@pytest.mark.parametrize(
    ("value", "used"),
    [("0", False), ("no", False), ("False", False), ("OFF", False), ("1", True), ("", True)],
)
def test_environment_variable_disables_native_code(value, used, monkeypatch):
    monkeypatch.setenv(native.SWITCH, value)
    probe = "from restock import native; print(native.IS_USED, native.state().startswith('in use'))"
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True)
    assert done.stdout.split() == [str(used)] * 2, done.stderr


@pytest.mark.parametrize("reason", ["disabled", "not compiled"])
def test_pytorch_is_used_without_native_code(reason: str, monkeypatch: pytest.MonkeyPatch) -> None:
    absent = "sys.modules['restock._native'] = None" if reason == "not compiled" else ""
    monkeypatch.setenv(native.SWITCH, "0" if reason == "disabled" else "1")
    probe = f"""
import sys
{absent}
from restock import native
from restock.cli import main
from restock.train.dqn.config import parse_config
from restock.train.dqn.learner import Learner

assert not native.IS_USED
print(Learner(parse_config({{}}, where="test"), 7, 4).path, flush=True)
main(["--version"])
"""
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    path, _, reported = done.stdout.splitlines()
    assert path == "autograd"
    assert reported.startswith("native code not in use: ")


@compiled
def test_gradients_of_two_forward_passes_add_up() -> None:
    held = network((16, 16), layer_norm=True)
    autograd = clone(held).requires_grad_()
    kernel = make_kernel(held)
    first, second = normal(5, OBSERVATION, seed=1), normal(9, OBSERVATION, seed=2)
    (kernel(first).square().mean() + kernel(second).square().mean()).backward()
    (autograd(first).square().mean() + autograd(second).square().mean()).backward()
    for one, other in zip(held.parameters(), autograd.parameters(), strict=True):
        torch.testing.assert_close(one.grad, other.grad, rtol=1e-4, atol=1e-5)


@compiled
@pytest.mark.parametrize("source", ["operator", "none"])
@pytest.mark.parametrize("double", [True, False])
def test_native_update_is_bit_identical_to_autograd(source, double, monkeypatch):
    settings = {"teacher": {"source": source}, "loss": {"double": double, "huber_delta": 0.5}}
    learner, oracle = (Learner(parse_config(settings, where="test"), 7, 4) for _ in range(2))
    oracle._has_kernels = False
    for seed, weight in ((1, None), (2, normal(37, seed=5).abs()), (3, None)):
        rows, labels = normal(37, 17, seed=seed), torch.arange(37) % 5 - 1
        rows[:, 14] = torch.arange(37) % 4
        labelled = behaviour.Labelled(rows[:, 3:10], labels)
        given = {"weight": weight, "logged": 9, "labelled": labelled}
        loss = learner.update(rows, **given)
        monkeypatch.setattr(behaviour, "Kernel", Learner)  # not its class
        expected = oracle.update(rows, **given)
        monkeypatch.undo()
        assert all(map(torch.equal, [loss.value, *learner.moved], [expected.value, *oracle.moved]))
