"""Drawing where the panel lies: the same code on the CPU and, where there is one, on a GPU."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from restock.errors import MixtureError
from restock.replay.sampling.device import DeviceSampler
from restock.replay.sampling.priorities import Lap, Per, Rule

STRATA = [np.arange(0, 400, 2), np.arange(1, 101, 2)]  # 200 and 50 rows
SHARES = [0.7, 0.3]


@pytest.fixture(params=["cpu", "cuda"])
def device(request: pytest.FixtureRequest) -> torch.device:
    if request.param == "cuda" and not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    return torch.device(request.param)


def sampler(device: torch.device, *, seed: int = 0, **way: Any) -> DeviceSampler:
    return DeviceSampler(STRATA, SHARES, 50, seed=seed, device=device, **way)


def priority(rule: Rule | None, td_abs: np.ndarray) -> np.ndarray:
    """As the papers have it."""
    if isinstance(rule, Per):
        return (td_abs + rule.epsilon) ** rule.alpha
    return np.maximum(td_abs, rule.floor) ** rule.alpha if rule else np.ones_like(td_abs)


def errors() -> np.ndarray:
    """|TD| of each row (400,), over three orders of magnitude."""
    return 10 ** np.random.default_rng(5).uniform(-2, 1, 400)


@pytest.mark.parametrize("beta", [0.4, 1.0])
def test_weights_are_those_of_the_distribution_drawn_from(
    device: torch.device, beta: float
) -> None:
    rule = Per(alpha=0.6, beta=beta, beta_batches=10**12)
    drawing, td = sampler(device, rule=rule), errors()
    for rows in STRATA:
        drawing.update(torch.from_numpy(rows).to(device), torch.from_numpy(td[rows]).to(device))
    drawn, stratum = drawing.draw()
    assert drawing.drawn_weights is not None
    weights = drawing.drawn_weights.cpu().numpy()
    for code, rows in enumerate(STRATA):
        p = priority(rule, td) / priority(rule, td[rows]).sum()
        mean = (p[rows] * (len(rows) * p[rows]) ** -beta).sum()
        mine = (stratum == code).cpu().numpy()
        np.testing.assert_allclose(
            weights[mine], (len(rows) * p[drawn.cpu().numpy()[mine]]) ** -beta / mean, rtol=1e-4
        )


def test_errors_that_are_negative_or_not_finite_are_refused_at_the_next_block(
    device: torch.device,
) -> None:
    for wrong in (float("nan"), float("inf"), -0.5):
        drawing = sampler(device, rule=Per())
        for _ in range(64):
            drawn, _ = drawing.draw()
        drawing.update(drawn, torch.full((50,), wrong, device=device))
        with pytest.raises(MixtureError, match="negative, or not finite"):
            drawing.draw()


def test_a_row_in_two_strata_is_refused() -> None:
    with pytest.raises(MixtureError, match="two strata"):
        DeviceSampler([np.arange(3), np.arange(2)], SHARES, 4, seed=0, device="cpu", rule=Lap())
