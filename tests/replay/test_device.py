"""Drawing where the panel lies: the same code on the CPU and, where there is one, on a GPU."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy import stats

from restock.errors import MixtureError
from restock.replay.sampling.device import DeviceSampler
from restock.replay.sampling.priorities import Lap, Per, Rule
from restock.train.run import checkpoint

STRATA = [np.arange(0, 400, 2), np.arange(1, 101, 2)]  # 200 and 50 rows
SHARES = [0.7, 0.3]
WAYS: dict[str, dict[str, Any]] = {
    "with replacement": {},
    "in turns": {"replacement": False},
    "PER": {"rule": Per(alpha=0.7)},
    "LAP": {"rule": Lap()},
    "in turns beside PER": {"rule": [None, Per(alpha=0.7)], "replacement": False},
}


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


@pytest.mark.parametrize("way", WAYS)
def test_quotas_are_exact_and_rows_drawn_as_the_rule_says(device: torch.device, way: str) -> None:
    drawing, td = sampler(device, **WAYS[way]), errors()
    given = WAYS[way].get("rule")
    rules = given if isinstance(given, list) else [given, given]
    for rows in STRATA:
        drawing.update(torch.from_numpy(rows).to(device), torch.from_numpy(td[rows]).to(device))
    counts = np.zeros(400)
    for _ in range(2000):
        drawn, stratum = drawing.draw()
        assert drawn.device.type == device.type
        assert torch.bincount(stratum).tolist() == [35, 15]
        np.add.at(counts, drawn.cpu().numpy(), 1)
    for rows, total, rule in zip(STRATA, (70_000, 30_000), rules, strict=True):
        assert counts[rows].sum() == total
        if rule is None and not WAYS[way].get("replacement", True):
            assert np.ptp(counts[rows]) <= 1
            continue
        share = priority(rule, td[rows])
        assert stats.chisquare(counts[rows], share / share.sum() * total).pvalue > 1e-4


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


@pytest.mark.parametrize("way", WAYS)
def test_a_restored_sampler_goes_on_exactly(device: torch.device, way: str, tmp_path: Path) -> None:
    def go_on(drawing: DeviceSampler, batches: int, seed: int) -> list[Any]:
        seen, rng = [], np.random.default_rng(seed)
        for index in range(batches):
            if index == 100:
                drawing.set_shares([0.2, 0.8])
            if index == 105:
                drawing.set_batch_size(31)
            drawn, stratum = drawing.draw()
            weights = drawing.drawn_weights
            seen += [
                drawn.tolist(),
                stratum.tolist(),
                None if weights is None else weights.tolist(),
            ]
            drawing.update(drawn, torch.from_numpy(rng.uniform(0, 9, len(drawn))).to(device))
        return seen

    first, second = (sampler(device, seed=seed, **WAYS[way]) for seed in (1, 2))
    go_on(first, 107, seed=1)  # on the way, what was drawn ahead is given back
    checkpoint.save(tmp_path / "state", first.state_dict())
    second.load_state_dict(checkpoint.load(tmp_path / "state"))
    assert go_on(first, 130, seed=2) == go_on(second, 130, seed=2)


def test_in_turns_what_is_given_back_is_no_turn(device: torch.device) -> None:
    drawing, counts = sampler(device, replacement=False), np.zeros(400)
    for index in range(300):
        if index % 7 == 0:
            share = (index % 5) / 5
            drawing.set_shares([1 - share, share])
            drawing.set_batch_size(20 + index % 11)
        drawn, _ = drawing.draw()
        assert len(drawn) == drawing.batch_size
        np.add.at(counts, drawn.cpu().numpy(), 1)
    assert all(np.ptp(counts[rows]) <= 1 for rows in STRATA)


def test_errors_that_are_not_finite_are_refused_at_the_next_block(device: torch.device) -> None:
    drawing = sampler(device, rule=Per())
    for _ in range(64):
        drawn, _ = drawing.draw()
    drawing.update(drawn, torch.full((50,), float("nan"), device=device))
    with pytest.raises(MixtureError, match="not finite"):
        drawing.draw()


def test_a_state_of_another_rule_is_refused() -> None:
    cpu = torch.device("cpu")
    with pytest.raises(MixtureError, match="another rule"):
        sampler(cpu, rule=Lap()).load_state_dict(sampler(cpu).state_dict())
    with pytest.raises(MixtureError, match="two strata"):
        DeviceSampler([np.arange(3), np.arange(2)], SHARES, 4, seed=0, device=cpu, rule=Lap())
