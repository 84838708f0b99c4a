"""The float32 matrix products of an update, by the faster of the two libraries that PyTorch has.

PyTorch's builds for x86 multiply with MKL, whose fast paths are for Intel's processors. On AMD's,
oneDNN takes just over half of MKL's time for matrices of a Q network (`benchmarks/train.py` shows
both), and it comes with PyTorch as well. Either is full float32: nothing is rounded to bfloat16.

Which of them multiplies follows from the machine and PyTorch's build alone, so that a run that is
resumed goes on to the last bit.
"""

from __future__ import annotations

import platform
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

_FEWEST = 1 << 20  # multiplications: below, a call of oneDNN costs more than it saves
_NOT_MKLS = ("AuthenticAMD", "HygonGenuine")  # processors that MKL has no fast path for


def affine(given: Tensor, weight: Tensor, bias: Tensor, *, relu: bool = False) -> Tensor:
    """x W^T + b, (n, O), of x (n, I), W (O, I) and b (O,); with `relu`, at least 0."""
    if _by_onednn(given, weight):
        return _onednn(given, weight, bias, "relu" if relu else "none")
    out = torch.addmm(bias, given, weight.t())
    return out.relu_() if relu else out


def product(left: Tensor, right: Tensor) -> Tensor:
    """left @ right, (n, m), of (n, k) and (k, m)."""
    if _by_onednn(left, right):
        return _onednn(left, right.t(), None, "none")
    return torch.mm(left, right)


def product_into(out: Tensor, left: Tensor, right: Tensor) -> None:
    """out = left @ right, (n, m), of (n, k) and (k, m)."""
    if _by_onednn(left, right):
        out.copy_(_onednn(left, right.t(), None, "none"))
    else:
        torch.mm(left, right, out=out)


def _by_onednn(left: Tensor, right: Tensor) -> bool:
    return (
        left.shape[0] * right.numel() >= _FEWEST
        and left.dtype == torch.float32
        and left.device.type == "cpu"
        and _onednn_is_faster()
    )


def _onednn(given: Tensor, weight: Tensor, bias: Tensor | None, then: str) -> Tensor:
    out: Tensor = torch.ops.mkldnn._linear_pointwise(given, weight, bias, then, [], "")
    return out


@cache
def _onednn_is_faster() -> bool:
    """Whether oneDNN multiplies: where MKL is slow, and where the operator does as it should."""
    if _vendor() not in _NOT_MKLS or not torch.backends.mkldnn.is_available():  # type: ignore[no-untyped-call]
        return False
    given, weight, bias = (torch.linspace(-1, 1, n) for n in (24 * 40, 56 * 40, 56))
    given, weight = given.view(24, 40), weight.view(56, 40)
    want = torch.addmm(bias, given, weight.t())
    try:
        plain, least = (_onednn(given, weight, bias, then) for then in ("none", "relu"))
        turned = _onednn(given.t(), given.t(), None, "none")
    except (AttributeError, RuntimeError, TypeError):  # gone, or called otherwise
        return False
    return (
        torch.allclose(plain, want, rtol=1e-5, atol=1e-5)
        and torch.allclose(least, want.relu(), rtol=1e-5, atol=1e-5)
        and torch.allclose(turned, given.t() @ given, rtol=1e-5, atol=1e-5)
    )


def _vendor() -> str:
    """Of the processor, as CPUID names it; empty where the system does not say."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = [f"vendor_id : {platform.processor().split(', ')[-1]}"]  # Windows
    return next((line.split(":")[1].strip() for line in lines if line.startswith("vendor_id")), "")


__all__ = ["affine", "product", "product_into"]
