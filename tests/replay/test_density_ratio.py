"""Density ratio against known values: outcome rates are restored, risky states stay boosted."""

import numpy as np
import pytest
from numpy.typing import NDArray
from support.stores import CONDITIONS, TASK, recording_transitions, write_store

from restock.ingest.task.task import Task
from restock.replay.mixture.mixture import CorrectionRule, StratumRule, parse_mixture
from restock.replay.panel.build import build_panel, open_source
from restock.replay.plan.plan import plan_panel
from restock.replay.plan.strata import ResolvedStratum
from restock.replay.plan.weights import (
    OutcomeModel,
    density_ratio,
    effective_count,
    importance_weights,
)
from restock.replay.store.store import Store

COUNT = 30_000


def slippery(seed: int = 0) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Return features (n, 4), the true probability of a slip (n,), and whether it slipped (n,)."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(COUNT, 4))
    chance = 1 / (1 + np.exp(-(-3.0 + 1.2 * x[:, 0] - 0.8 * x[:, 1])))
    return x, chance, rng.random(COUNT) < chance


def strata(correction: str) -> list[ResolvedStratum]:
    return [
        ResolvedStratum(StratumRule(name="slip"), "true", None, 1, "post", correction),  # type: ignore[arg-type]
        ResolvedStratum(StratumRule(name="nominal"), "true", None, 9, "pre", "none"),
    ]


def test_estimate_matches_true_ratio():
    x, chance, slipped = slippery()
    share = 0.5
    boost = np.array([share / slipped.mean(), (1 - share) / (1 - slipped.mean())])
    truth = (chance * boost[0] + (1 - chance) * boost[1]) / boost[1]
    model = OutcomeModel(x, slipped.astype(np.int64), 2)
    estimated = model.probability(x)[:, 1].astype(np.float32)
    outcome = np.stack([estimated, np.zeros(COUNT, np.float32)], axis=1)
    ratio = density_ratio(outcome, boost, np.full(COUNT, boost[1]), clip=1e9)
    error = np.abs(np.log(ratio) - np.log(truth))
    assert error.mean() < 0.05
    assert np.quantile(error, 0.99) < 0.15
    clipped = density_ratio(outcome, boost, np.full(COUNT, boost[1]), clip=2.0)
    np.testing.assert_allclose(clipped, np.minimum(ratio, 2.0))


def test_fit_on_weighted_subsample_is_unbiased():
    x, chance, slipped = slippery()
    rng = np.random.default_rng(1)
    kept = slipped | (rng.random(COUNT) < 0.2)
    weight = np.where(slipped, 1.0, 5.0)[kept]
    model = OutcomeModel(x[kept], slipped[kept].astype(np.int64), 2, weight)
    assert np.abs(model.probability(x)[:, 1] - chance).mean() < 0.02


@pytest.mark.parametrize("estimate", ["true", "useless"])
def test_outcome_rates_are_restored_even_by_useless_fit(estimate):
    """The weighted P(slip | state) equals the logged one in every part of the state space."""
    _, chance, slipped = slippery()
    code = np.where(slipped, 0, 1).astype(np.int16)
    state = np.ones(COUNT, np.int16)
    shares = np.array([0.5, 0.5])
    guess = chance if estimate == "true" else np.full(COUNT, slipped.mean())
    outcome = np.stack([guess, np.zeros(COUNT)], axis=1).astype(np.float32)
    rule = CorrectionRule(clip=50.0)
    weight = importance_weights(code, state, strata("density_ratio"), shares, rule, outcome)
    drawn = (shares / np.bincount(code))[code]
    assert (drawn * weight).sum() == pytest.approx(1, rel=1e-4)
    risk = np.digitize(chance, [0.02, 0.05, 0.1, 0.3])
    for part in range(5):
        mine = risk == part
        after = (drawn * weight)[mine & slipped].sum() / (drawn * weight)[mine].sum()
        # The ratio varies within a part, which shifts the weighted rows inside it.
        assert after == pytest.approx(slipped[mine].mean(), rel=0.12)
    # Uncorrected, slips are far too frequent.
    raw = drawn[(risk == 2) & slipped].sum() / drawn[risk == 2].sum()
    assert raw > 4 * slipped[risk == 2].mean()


def test_density_ratio_keeps_risky_states_boosted():
    _, chance, slipped = slippery()
    code = np.where(slipped, 0, 1).astype(np.int16)
    state, shares = np.ones(COUNT, np.int16), np.array([0.5, 0.5])
    outcome = np.stack([chance, np.zeros(COUNT)], axis=1).astype(np.float32)
    drawn = (shares / np.bincount(code))[code]
    risky = chance > 0.3

    weighted = {
        name: drawn
        * importance_weights(code, state, strata(name), shares, CorrectionRule(clip=50.0), given)
        for name, given in (("none", None), ("density_ratio", outcome), ("full", None))
    }
    natural = risky.mean()
    assert weighted["full"][risky].sum() == pytest.approx(natural, rel=0.01)
    assert weighted["density_ratio"][risky].sum() == pytest.approx(drawn[risky].sum(), rel=0.05)
    assert drawn[risky].sum() > 2.5 * natural
    # The effective count is between those of full and of no correction.
    effective = {name: effective_count(weights) for name, weights in weighted.items()}
    assert effective["full"] == pytest.approx(COUNT, rel=1e-3)
    assert effective["none"] < effective["density_ratio"] < effective["full"]


TEXT = """
[correction]
post = "density_ratio"
below_natural = "allow"  # labels are random: no state predicts them
[each_condition]
share = "equal"
"""


def test_panel_keeps_outcome_probabilities(transitions, tmp_path):
    mixture = parse_mixture(TEXT)
    with open_source(transitions, mixture, task=TASK, conditions=CONDITIONS) as source:
        plan = plan_panel(source.connection, mixture, source.conditions)
    (fit,) = plan.ratios
    assert set(fit.strata) == {s.name for s in plan.strata if s.timing == "post"}
    assert fit.base_log_loss > 0
    assert fit.rows > 100
    share = np.array([line.share for line in plan.strata])
    rows = np.array([line.rows for line in plan.strata])
    code = plan.stratum[plan.panel_rows]
    assert ((share / rows)[code] * plan.weight).sum() == pytest.approx(1, rel=1e-4)
    panel = build_panel(transitions, mixture, f"{tmp_path}/panel", task=TASK, conditions=CONDITIONS)
    for name in fit.strata:
        chance = panel.meta[f"probability_of_{name}"].to_numpy()
        assert ((chance >= 0) & (chance <= 1)).all()
        # These labels are random, so the features predict only their mean.
        assert chance.mean() == pytest.approx(
            (panel.meta["stratum"].to_pylist()).count(name) / len(panel), abs=0.02
        )
    assert panel.header.ratios == [fit]


def test_rows_of_other_task_do_not_change_estimates(tmp_path):
    """Their observations have another size and may be in the same batch."""
    other = Task(body=TASK.body, actions=TASK.actions, sectors=6)
    mine = recording_transitions(2)
    alone = write_store(tmp_path / "alone", [mine])
    beside = write_store(tmp_path / "beside", [recording_transitions(1, task=other)], task=other)
    write_store(beside, [mine])
    split = '[evaluation_split]\nby = "none"'  # a split would cover all episodes of a store
    mixture = parse_mixture(f"where = \"task_hash = '{TASK.hash}'\"\n{TEXT}\n{split}")
    panels = [
        build_panel(Store(path), mixture, tmp_path / f"of-{path.name}") for path in (alone, beside)
    ]
    assert panels[0].header.ratios
    assert panels[1].header.ratios == panels[0].header.ratios
    assert panels[1].meta["weight"].equals(panels[0].meta["weight"])
