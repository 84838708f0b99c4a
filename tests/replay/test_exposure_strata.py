"""Strata by exposure instead of outcome: quotas, and the audit that tells them apart."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from support.panels import planned
from support.stores import CONDITIONS, recording_transitions, write_store

from restock.errors import ConfigError, MixtureError
from restock.ingest.store.transitions import replaced
from restock.replay.mixture.mixture import parse_mixture
from restock.replay.panel.build import build_panel
from restock.replay.plan.plan import PanelPlan, plan_panel
from restock.replay.store.audit import load_thresholds, run_audits, shipped_audits
from restock.replay.store.store import Store

EPISODES = 60
# Every third episode is exposed to traffic; every other of these came too near and failed.
EXPOSED = [number % 3 == 0 for number in range(EPISODES)]
NEAR = [number % 6 == 0 for number in range(EPISODES)]


def planted(failed: Callable[[int], bool], near: list[bool] = NEAR) -> pa.Table:
    """Return a recording with exposures as in EXPOSED and near collisions as in `near`."""
    rows = recording_transitions(1, episodes=EPISODES, seed=3)
    episode = rows["episode_index"].to_numpy()
    step = rows["step_index"].to_numpy()
    last = np.append(step[1:] == 0, True)
    held = [near[e] and s in (3, 4) for e, s in zip(episode, step, strict=True)]
    success = np.array([not failed(number) for number in range(EPISODES)])[episode]
    return replaced(
        rows,
        {
            "conditions": [["near_collision"] if one else [] for one in held],
            "condition": ["near_collision" if one else "nominal" for one in held],
            "uncertain": [[] for _ in held],
            "exposures": [
                ["closing_traffic"] if EXPOSED[e] and s < 6 else []
                for e, s in zip(episode, step, strict=True)
            ],
            "bumped": np.zeros(len(rows), np.bool_),
            "reward": np.where(last & success, 5.0, -0.02),  # rewards of the task
            "terminated": last & success,
            "truncated": last & ~success,
        },
    )


def success_in(plan: PanelPlan, stratum: str, rows: pa.Table) -> float:
    """Return the share of a stratum's episodes that reached the goal."""
    (code,) = [place for place, line in enumerate(plan.strata) if line.name == stratum]
    mine = set(plan.rows.filter(pa.array(plan.stratum == code))["episode_id"].to_pylist())
    good = set(rows.filter(rows["terminated"])["episode_id"].to_pylist())
    return len(mine & good) / len(mine)


BY_OUTCOME = (
    "[evaluation_split]\nby = 'none'\n[[strata]]\nname = 'nominal'\nunit = 'episode'\nshare = 0.5\n"
    "[each_condition]\nunit = 'episode'\nshare = 'equal'\n"
)
BY_EXPOSURE = BY_OUTCOME + "kind = 'exposure'"


def test_exposure_stratum_keeps_successes(tmp_path):
    rows = planted(lambda number: NEAR[number])
    store = write_store(tmp_path / "store", [rows])
    outcome, exposure = planned(store, BY_OUTCOME), planned(store, BY_EXPOSURE)
    names = {line.name: line.episodes for line in exposure.strata}
    assert names == {"nominal": 40, "closing_traffic": 20, "plan_blocked": 0, "slippery_floor": 0}
    assert "closing_traffic" not in {line.name for line in outcome.strata}
    assert success_in(outcome, "near_collision", rows) == 0
    assert success_in(exposure, "closing_traffic", rows) == 0.5
    assert success_in(outcome, "nominal", rows) == success_in(exposure, "nominal", rows) == 1


def test_remedy_does_not_suggest_existing_key(tmp_path):
    rows = planted(lambda number: NEAR[number])
    store = write_store(tmp_path / "store", [replaced(rows, {"exposures": [[]] * len(rows)})])
    with pytest.raises(MixtureError, match="belong to no stratum") as refused:
        planned(store, "[each_condition]\nkind = 'exposure'")
    assert "each_condition" not in str(refused.value)


def test_rows_go_to_condition_before_exposure(tmp_path):
    """Among strata of steps a condition comes first, as its priority number is lower."""
    store = write_store(tmp_path / "store", [planted(lambda number: False)])
    text = "[evaluation_split]\nby = 'none'\n[correction]\npost = 'none'\n" + "".join(
        f"[[strata]]\nname = '{name}'\n"
        for name in ("nominal", "near_collision", "closing_traffic")
    )
    lines = {line.name: line for line in planned(store, text).strata}
    assert lines["closing_traffic"].timing == "pre"
    # Exposed episodes have six exposed steps; in every other one the condition takes two.
    assert lines["near_collision"].rows == 20
    assert lines["closing_traffic"].rows == 6 * 20 - 20


def test_exposure_panel_lists_its_conditions(tmp_path):
    store = write_store(tmp_path / "store", [planted(lambda number: NEAR[number])])
    with Store(store) as opened:
        panel = build_panel(opened, parse_mixture(BY_EXPOSURE), tmp_path / "panel")
    assert {"closing_traffic", "nominal"} <= {line.name for line in panel.header.strata}
    assert panel.header.conditions == [  # each row has one of these; exposures are not conditions
        *("recovery", "near_collision", "wheel_slip", "blocked_aisle", "nominal")
    ]


def test_table_in_memory_has_exposure_strata(tmp_path):
    panel = build_panel(planted(lambda number: False), parse_mixture(BY_EXPOSURE), tmp_path / "p")
    assert "closing_traffic" in {line.name for line in panel.header.strata}


def test_store_without_exposures_is_refused(tmp_path):
    store = write_store(tmp_path / "store", [planted(lambda number: False)])
    with Store(store) as opened, pytest.raises(ConfigError, match="the store has none") as caught:
        plan_panel(opened.connection, parse_mixture(BY_EXPOSURE), CONDITIONS)
    assert "ingest" in str(caught.value.remedy)


def audited(store: Path) -> tuple[str, list[dict[str, object]]]:
    chosen = [audit for audit in shipped_audits() if audit.name == "chosen_on_outcome"]
    thresholds = {"chosen_on_outcome": load_thresholds()["chosen_on_outcome"]}
    with Store(store) as opened:
        (finding,) = run_audits(opened.connection, chosen, thresholds)
    return finding.status, finding.sample


def test_audit_finds_condition_chosen_on_outcome(tmp_path, shell):
    store = write_store(tmp_path / "store", [planted(lambda number: NEAR[number])])
    status, sample = audited(store)
    assert status == "warn"
    assert sample == [
        {
            "condition": "near_collision",
            "exposure": "closing_traffic",
            "episodes": 10,
            "success_share": 0.0,
            "exposed_episodes": 20,
            "exposed_success_share": 0.5,
            "left_out_episodes": 10,
            "left_out_success_share": 1.0,
        }
    ]
    assert 'kind = "exposure"' in shell.out("audit", store, "--strict", code=1)


@pytest.mark.parametrize(
    ("failed", "near"),
    [
        (lambda number: False, NEAR),  # nothing failed
        (lambda number: EXPOSED[number] and number % 2 == 0, [n % 12 < 4 for n in range(60)]),
        (lambda number: NEAR[number], EXPOSED),  # the condition is the situation
    ],
)
def test_audit_passes_conditions_without_outcome_bias(tmp_path, failed, near):
    store = write_store(tmp_path / "store", [planted(failed, near)])
    assert audited(store) == ("pass", [])
