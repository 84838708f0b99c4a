"""Check the stratum shares of a run and the limit of replays per row."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.panels import LIMITED
from support.stores import CONDITIONS, recording_transitions
from support.toy_run import config, run_to_end
from support.toy_twin import TASK as TOY_TASK

from restock.errors import MixtureError
from restock.replay.mixture.mixture import parse_mixture
from restock.replay.mixture.share_controller import PlannedDraws, SampledStratum, ShareController
from restock.replay.panel.build import build_panel
from restock.replay.panel.logged_sampler import LoggedSampler
from restock.replay.panel.panel import Panel
from restock.replay.plan.strata import rules_of
from restock.train.feed.logs import Logs
from restock.train.session import Session

HALVES = "[[strata]]\nname = 'nominal'\nshare = 0.5\n[[strata]]\nname = 'rare'\nshare = 0.5\n"


def controller(text: str, rows: list[int], planned: PlannedDraws, **more: Any) -> ShareController:
    mixture = parse_mixture(text)
    names = [rule.name for rule in mixture.strata]
    strata = [
        SampledStratum(name, "logs", rule, count, 9)
        for name, rule, count in zip(names, rules_of(mixture, names), rows, strict=True)
    ]
    return ShareController(mixture, strata, planned, **more)


def test_shares_respect_replay_cap_of_planned_draws() -> None:
    text = "max_replays_per_row = 50\nplanned_draws = 128\n" + HALVES
    # 100,000 online rows, half of them logs: 50,000; 100 rows x 50 are a tenth of that.
    plan = controller(text, [10_000, 100], PlannedDraws(0, 100_000, 0, 1000))
    np.testing.assert_allclose(plan.shares, [0.9, 0.1])
    assert plan.logs_share == 0.5
    # A run of twice the length halves the share.
    plan = controller(text, [10_000, 100], PlannedDraws(0, 200_000, 0, 1000))
    np.testing.assert_allclose(plan.shares, [0.95, 0.05])
    # All rows allow 20,000 of 60,000 draws: 10,000 offline and 10,000 of 50,000 online.
    plan = controller(text, [300, 100], PlannedDraws(10_000, 100_000, 0, 1000))
    np.testing.assert_allclose(plan.shares, [0.75, 0.25])
    assert plan.logs_share == pytest.approx(0.1)
    message = r"offline phase draws 30,000 rows of logs.*400 rows"
    with pytest.raises(MixtureError, match=message) as raised:
        controller(text, [300, 100], PlannedDraws(30_000, 100_000, 0, 1000))
    assert "lower schedule.offline_updates to 66.6% of its value" in str(raised.value)
    controller(text, [300, 100], PlannedDraws(19_980, 100_000, 0, 1000))
    with pytest.raises(MixtureError, match=r"rare wants 50\.0% of 50,000 draws, its 100 rows"):
        controller(
            "shortfall = 'refuse'\n" + text, [10_000, 100], PlannedDraws(0, 100_000, 0, 1000)
        )
    shrunk = controller(
        "shortfall = 'shrink'\n" + text, [10_000, 100], PlannedDraws(0, 100_000, 0, 1)
    )
    np.testing.assert_allclose(shrunk.shares, [5 / 6, 1 / 6])
    assert shrunk.logs_share == pytest.approx(0.3)


def test_capped_rows_are_used_up_over_the_run() -> None:
    """Check that a shortfall of draws is not requested again at each new share."""
    plan = controller(
        f"max_replays_per_row=50\n{HALVES}", [100, 100], PlannedDraws(0, 128_000, 0, 1000)
    )
    owed = 0.0
    for step in range(1000):
        plan.at(step)
        owed += 128 * plan.logs_share
        plan.count(np.arange(int(owed)) % 2)
        owed -= int(owed)
    assert plan.drawn.sum() == pytest.approx(200 * 50, rel=0.05)


@pytest.fixture(scope="module")
def table() -> pa.Table:
    return pa.concat_tables([recording_transitions(index, task=TOY_TASK) for index in (1, 2, 3)])


def panel(table: pa.Table, path: Path, text: str) -> Panel:
    whole = "discount = 0.9\n" + text
    return build_panel(table, parse_mixture(whole), path, task=TOY_TASK, conditions=CONDITIONS)


def sampler_of(panel: Panel, planned: PlannedDraws) -> LoggedSampler:
    return Logs.of_panel(panel, planned).sampler(64, None, 0)


@pytest.mark.parametrize("within", ["without_replacement", "uniform", "per"])
def test_no_row_exceeds_max_replays(table, tmp_path, within):
    text = f"max_replays_per_row = 9\nwithin = '{within}'\n[each_condition]\nshare = 'equal'\n"
    built = panel(table, tmp_path / "p", text)
    draws = sampler_of(built, PlannedDraws(offline=4_000))
    rng = np.random.default_rng(0)
    counted = np.zeros(len(built), np.int64)
    drawn = 0
    # Draw more than was planned: the limit still holds.
    while True:
        batch = draws.draw(64)
        np.add.at(counted, batch.rows, 1)
        drawn += len(batch.rows)
        np.testing.assert_array_equal(built.stratum_code[batch.rows], batch.strata)
        assert counted.max() <= 9
        if len(batch.rows) < 64:
            break
        draws.update(batch.rows, rng.random(64))
    assert drawn == 9 * len(built)  # all allowed draws were made
    np.testing.assert_array_equal(draws.replays, counted)
    rows = draws.describe()
    assert all(row["exhausted"] and row["replays_max"] == 9 for row in rows if row["rows"])
    if within != "without_replacement":
        assert sum(row["replaced_rows"] for row in rows) > 0
    assert draws.draw(64).rows.size == 0


def test_exhausted_stratum_gives_its_share_to_others(table: pa.Table, tmp_path: Path) -> None:
    text = "max_replays_per_row = 20\n[[strata]]\nname = 'near_collision'\nshare = 0.5\n"
    built = panel(table, tmp_path / "p", text + "[each_condition]\n")
    draws = sampler_of(built, PlannedDraws(online=10))  # far fewer draws than are made
    place = [stratum.name for stratum in built.strata].index("near_collision")
    assert draws.controller.shares[place] == 0.5
    limit = 20 * built.strata[place].rows
    while draws.controller.drawn[place] < limit:
        draws.draw(64)
    assert draws.controller.shares[place] == 0
    assert draws.controller.shares.sum() == pytest.approx(1)
    before = draws.controller.drawn[place]
    assert len(draws.draw(64).rows) == 64
    assert draws.controller.drawn[place] == before == limit


def test_weights_follow_current_shares(table: pa.Table, tmp_path: Path) -> None:
    """Check that full correction preserves P(outcome) under any shares."""
    text = LIMITED.replace("density_ratio", "full")
    built = panel(table, tmp_path / "p", text)
    draws = sampler_of(built, PlannedDraws(0, 1_000, 0, 1200))
    post = np.array([stratum.timing == "post" for stratum in built.strata])
    rows = np.array([stratum.rows for stratum in built.strata])
    moved = []
    for online in (1_000, 10_000, 30_000):
        draws.replan(PlannedDraws(0, online, 0, 1200))
        shares = draws.controller.shares
        moved.append(tuple(shares))
        weight = draws.weights_of(np.arange(len(built)))
        assert weight is not None
        mean = np.bincount(built.stratum_code, weight) / np.maximum(rows, 1)
        assert (shares * mean).sum() == pytest.approx(1, rel=1e-4)
        density = shares * mean / rows
        nominal = [stratum.name for stratum in built.strata].index("nominal")
        # Rows of the nominal state have equal probability for all outcomes.
        state = built.meta["state_code"].to_numpy()
        of_nominal = state == nominal
        per_row = (shares / rows)[built.stratum_code] * weight
        np.testing.assert_allclose(per_row[of_nominal], density[nominal], rtol=1e-4)
        assert (post[built.stratum_code] & of_nominal).any()
    assert len(set(moved)) == 3


def toy_logs(built: Panel) -> Logs:
    return Logs.of_panel(built, PlannedDraws(60 * 32, 350 * 32, 200, 1600))


SETTINGS = config(replay={"logs_share": None}, schedule={"env_steps": 1600})


@pytest.fixture(scope="module")
def whole(table: pa.Table, tmp_path_factory: pytest.TempPathFactory) -> tuple[Session, Panel]:
    """Return a finished run whose mixture limits replays, and its panel."""
    path = tmp_path_factory.mktemp("runs")
    built = panel(table, path / "panel", LIMITED)
    return run_to_end(path / "whole", SETTINGS, logs=toy_logs(built)), built


def test_run_records_current_shares(whole: tuple[Session, Panel]) -> None:
    live, built = whole
    path, size = live.run.path, len(built.strata)
    shares = pq.read_table(path / "shares.parquet").to_pylist()
    assert len(shares) > 4 * size
    for first in range(0, len(shares), size):
        mine = shares[first : first + size]
        assert sum(row["share"] for row in mine) == pytest.approx(1)
        assert all(row["replays_max"] <= 40 for row in mine)
    last = shares[-size:]
    assert live.batches.controller is not None
    np.testing.assert_allclose([row["share"] for row in last], live.batches.controller.shares)
    assert [row["share"] for row in last] != [row["planned_share"] for row in last]
    # The drawn shares match the requested ones.
    strata = pq.read_table(path / "strata.parquet").to_pylist()
    for row in strata:
        if row["source"] == "logs" and row["phase"] == "online":
            assert row["drawn_share"] == pytest.approx(row["quota_share"], abs=0.03)
    ages = pq.read_table(path / "ages.parquet").to_pylist()
    assert max(row["bucket"] for row in ages if row["unit"] == "env_steps") <= 9  # 2 ** 9 <= 900
