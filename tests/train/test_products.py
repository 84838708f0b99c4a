"""An update's products and Adam: what PyTorch's public ways give, whichever library multiplies."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch import nn

from restock import native
from restock.train.dqn import products
from restock.train.dqn.flat_adam import FlatAdam
from restock.train.dqn.products import affine, product, product_into

LARGE = (128, 94, 256)  # rows, inputs, outputs: a first layer's


@pytest.fixture(params=["AuthenticAMD", "GenuineIntel"])
def vendor(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    products._onednn_is_faster.cache_clear()
    monkeypatch.setattr(products, "_vendor", lambda: request.param)
    yield request.param
    products._onednn_is_faster.cache_clear()


def close(given: torch.Tensor, exact: torch.Tensor) -> bool:
    """To float32's rounding: bfloat16 would be off by a hundred times as much."""
    return bool((given.double() - exact).abs().max() < 2e-6 * exact.abs().max())


@pytest.mark.usefixtures("vendor")
@pytest.mark.parametrize("sizes", [LARGE, (16, 5, 3), (128, 256, 10), (256, 256, 256)])
def test_products_are_full_float32(sizes: tuple[int, int, int]) -> None:
    rows, inputs, outputs = sizes
    rng = torch.Generator().manual_seed(0)
    wide = torch.randn(rows, 2 * inputs + 3, generator=rng)
    weight, bias = (torch.randn(outputs, *more, generator=rng) for more in ((inputs,), ()))
    for given in (wide[:, :inputs].contiguous(), wide[:, :inputs]):
        exact = given.double() @ weight.double().t() + bias.double()
        assert close(affine(given, weight, bias), exact)
        least = affine(given, weight, bias, relu=True)
        assert close(least, exact.relu())
        assert float(least.min()) >= 0
        assert close(product(given, weight.t()), exact - bias)
    down = torch.randn(rows, outputs, generator=rng)
    out = torch.full((outputs, inputs), torch.nan)
    product_into(out, down.t(), wide[:, :inputs].contiguous())
    assert close(out, down.double().t() @ wide[:, :inputs].double())


@pytest.mark.usefixtures("vendor")
def test_the_same_product_twice_has_the_same_bits() -> None:
    given, weight, bias = torch.randn(256, 94), torch.randn(256, 94), torch.randn(256)
    assert torch.equal(affine(given, weight, bias), affine(given.clone(), weight.clone(), bias))


def test_onednn_multiplies_where_mkl_has_no_fast_path(vendor: str) -> None:
    if not torch.backends.mkldnn.is_available():
        pytest.skip("this PyTorch has no oneDNN")
    assert products._onednn_is_faster() == (vendor == "AuthenticAMD")


def wrong(given: torch.Tensor, weight: torch.Tensor, *_: Any) -> torch.Tensor:
    return (given @ weight.t()).bfloat16().float()


def called_otherwise(*_: Any) -> None:
    raise TypeError("takes 5 positional arguments")


@pytest.mark.parametrize("kernel", [wrong, called_otherwise], ids=["rounds", "other"])
def test_an_operator_that_does_something_else_is_not_used(
    kernel: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(products, "_vendor", lambda: "AuthenticAMD")
    monkeypatch.setattr(products, "_onednn", kernel)
    products._onednn_is_faster.cache_clear()
    assert not products._onednn_is_faster()
    products._onednn_is_faster.cache_clear()


@pytest.mark.parametrize("max_grad_norm", [None, 0.5])
@pytest.mark.parametrize("compiled", [False, True] if native.is_used() else [False])
def test_adam_moves_as_pytorchs_does(max_grad_norm: float | None, compiled: bool) -> None:
    torch.manual_seed(0)
    ours, theirs = nn.Linear(48, 16), nn.Linear(48, 16)  # sizes of whole cache lines
    theirs.load_state_dict(ours.state_dict())
    flat = FlatAdam(ours, 1e-2, max_grad_norm, compiled=compiled)
    average = flat.values.clone()
    followed = average.clone()
    whole = torch.cat([part.detach().flatten() for part in theirs.parameters()])
    adam = torch.optim.Adam([whole], lr=1e-2, fused=True)
    for _ in range(20):
        flat.gradient.normal_()
        whole.grad = flat.gradient.clone()
        flat.step(average, 0.1)
        if max_grad_norm is not None:
            torch.nn.utils.clip_grad_norm_([whole], max_grad_norm)
        adam.step()
        followed.lerp_(whole, 0.1)
    assert torch.equal(flat.values, whole)
    assert torch.equal(average, followed)
    assert float(flat.moments["0"]["step"]) == 20
    flat.forget()
    assert flat.moments == {}
