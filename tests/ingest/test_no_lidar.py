"""Robots without a lidar: clearance and every condition that needs it are unknown."""

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from support.driven_robot import Drive, columns, scans, write_bag
from support.ingested import ingested, proposed
from support.profile_texts import WAREHOUSE

from restock.errors import MixtureError
from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.pipeline import IngestResult, ingest
from restock.ingest.profile.profile import load_profile, parse_profile
from restock.ingest.steps.episodes import steps_of
from restock.ingest.store.writer import StoreWriter
from restock.ingest.task.robot import NONE, SPEED, Limits, limit
from restock.ingest.task.task import LIDAR_SIGNALS, STORED_SIGNALS
from restock.replay.mixture.mixture import parse_mixture
from restock.replay.plan.plan import plan_panel
from restock.replay.store.audit import load_thresholds, run_audits, shipped_audits
from restock.replay.store.store import Store
from restock.replay.trace.trace import trace_row

NEED_LIDAR = ["blocked_aisle", "closing_traffic", "near_collision", "plan_blocked", "recovery"]
SCAN = re.search(r"\[inputs\.scan\].*?\n\n", WAREHOUSE, re.DOTALL)
assert SCAN is not None
BLIND = parse_profile(WAREHOUSE.replace(SCAN[0], ""), where="blind.toml")
OPTIONAL = parse_profile(
    WAREHOUSE.replace(SCAN[0], SCAN[0].rstrip() + "\noptional = true\n\n"), where="optional.toml"
)
MIXTURE = """
{more}
[evaluation_split]
by = "none"
[[strata]]
name = "near_collision"
share = 0.4
[[strata]]
name = "wheel_slip"
share = "equal"
[[strata]]
name = "nominal"
share = "natural"
"""


class BlindDrive(Drive):
    """The default drive of a robot without a lidar."""

    drop = ("/scan",)


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of recordings: `seeing` with a scan, `blind` without."""
    folder = tmp_path_factory.mktemp("drives")
    write_bag(Drive(), folder / "seeing")
    write_bag(BlindDrive(duration_s=9.0), folder / "blind")
    return folder


@pytest.fixture(scope="module")
def blind(drives: Path) -> tuple[Path, IngestResult]:
    """Return a store of the drive without a lidar, and the ingest result."""
    store = drives / "store"
    return store, ingest(drives / "blind", BLIND, store=StoreWriter(store))


def test_profile_without_scan_has_no_sectors():
    assert "sectors = 36" in WAREHOUSE
    assert (BLIND.task.sectors, BLIND.task.lidar) == (0, False)
    lidar = [n for n in load_profile("warehouse_amr").task.observation_names if "deg" in n]
    assert len(lidar) == 72
    names = load_profile("warehouse_amr").task.observation_names
    assert BLIND.task.observation_names == [name for name in names if name not in lidar]
    assert BLIND.task.observation_size == len(names) - 72


def test_clearance_columns_are_null_without_lidar(drives, blind):
    path, outcome = blind
    with Store(path) as store:
        rows = store.sql("FROM transitions ORDER BY step_index").to_arrow_table()
        unknown = store.sql("SELECT condition, because FROM unknown_conditions").fetchall()
    for name in LIDAR_SIGNALS & {signal.name for signal in STORED_SIGNALS}:
        assert rows[name].null_count == len(rows) > 20, name
    observation = np.stack(rows["observation"].to_numpy())
    assert observation.shape == (len(rows), BLIND.task.observation_size)
    assert np.isfinite(observation).all()
    assert sorted(unknown) == [(name, "no lidar") for name in NEED_LIDAR]
    assert not set(outcome.conditions) & set(NEED_LIDAR)
    assert {*outcome.conditions, *outcome.exposures} >= {"wheel_slip", "slippery_floor"}
    for row in rows.to_pylist(maps_as_pydicts="strict"):
        assert not {*row["probabilities"]} & set(NEED_LIDAR)

    seeing = ingest(drives / "seeing", load_profile("warehouse_amr"), store=None)
    assert seeing.manifest["unknown_conditions"] == []


def test_traced_reward_has_no_clearance_term(blind):
    path, _ = blind
    with Store(path) as store:
        ((row,),) = store.sql("SELECT min(transition_id) FROM transitions").fetchall()
    assert trace_row(path, str(row)).origin.reward_parts["tight"] == 0.0


def test_unknown_clearance_costs_no_reward(tmp_path):
    """The term `tight` is 0 if clearance is unknown; with the lidar each step costs 0.05."""

    class Tight(Drive):
        def topics(self) -> Mapping[str, TopicColumns]:
            near = columns(np.arange(0, 6, 0.1), scans(np.full((60, 72), 0.4)))
            return {**super().topics(), "/scan": near}

    rewards = {}
    write_bag(Tight(), tmp_path / "tight")
    for name, profile in (("lidar", load_profile("warehouse_amr")), ("none", BLIND)):
        ingest(tmp_path / "tight", profile, store=StoreWriter(tmp_path / name))
        with Store(tmp_path / name) as store:
            query = "SELECT reward FROM transitions ORDER BY step_index"
            rewards[name] = store.sql(query).to_arrow_table()["reward"].to_numpy()
    assert rewards["none"] - rewards["lidar"] == pytest.approx(np.full(29, 0.05), abs=1e-6)


def test_missing_optional_scan_gives_task_without_lidar(drives, blind, tmp_path):
    """A task never mixes rows with and without measured clearance."""
    _, first = blind
    second = ingest(drives / "blind", OPTIONAL, store=StoreWriter(tmp_path / "store"))
    assert second.manifest["task_hash"] == first.manifest["task_hash"] == BLIND.task.hash
    assert ingest(drives / "seeing", OPTIONAL, store=None).manifest["task_hash"] == (
        load_profile("warehouse_amr").task.hash
    )
    again = ingest(drives / "blind", OPTIONAL, store=StoreWriter(tmp_path / "store"))
    assert again.status == "unchanged"


def test_steps_before_first_optional_scan_are_unusable():
    """On a robot an optional scan may be late; free space would be a guess."""
    steps = steps_of(OPTIONAL, BlindDrive().topics())
    assert set(steps.problem) == {"scan: not yet received"}
    assert set(steps_of(BLIND, BlindDrive().topics()).problem) == {""}


def test_unknown_conditions_have_no_counts(blind):
    path, _ = blind
    with Store(path) as store:
        held = dict(store.sql("SELECT condition, rows_held FROM coverage_by_condition").fetchall())
        cells = store.sql("SELECT condition, action, rows_held FROM coverage").fetchall()
        missing = store.sql("SELECT DISTINCT condition FROM missing_cells").fetchall()
        observed = dict(store.sql("SELECT exposure, rows FROM coverage_by_exposure").fetchall())
        findings = run_audits(store.connection, shipped_audits(), load_thresholds())
    outcomes = {"blocked_aisle", "near_collision", "recovery"}
    assert {name for name, rows in held.items() if rows is None} == outcomes
    assert {line for line in cells if line[2] is None} == {(name, None, None) for name in outcomes}
    assert ("wheel_slip",) in missing
    assert not {(name,) for name in outcomes} & set(missing)
    assert {name for name, rows in observed.items() if rows is None} == set(NEED_LIDAR) - outcomes
    found = {finding.audit.name: finding for finding in findings}
    assert found["unknown_conditions"].status == "warn"
    assert {line["condition"] for line in found["unknown_conditions"].sample} <= set(NEED_LIDAR)
    assert not outcomes & {line["condition"] for line in found["rare_condition"].sample}


def test_one_drive_with_lidar_restores_zero_counts(drives, tmp_path):
    writer = StoreWriter(tmp_path / "store")
    ingest(drives / "blind", BLIND, store=writer)
    ingest(drives / "seeing", load_profile("warehouse_amr"), store=writer)
    with Store(tmp_path / "store") as store:
        query = "SELECT rows_held FROM coverage_by_condition WHERE condition = 'near_collision'"
        assert store.sql(query).fetchall() == [(0,)]
        assert store.sql("FROM untold_conditions").fetchall() == []
        assert len(store.sql("FROM unknown_conditions").fetchall()) == len(NEED_LIDAR)


def test_quota_on_unknown_condition_reports_reason(blind):
    path, _ = blind
    with Store(path) as store:
        known = [*store.conditions(), *store.exposures()]
        text = MIXTURE.format(more="")
        plan = plan_panel(store.connection, parse_mixture(text, where="mix.toml"), known)
        line = next(line for line in plan.strata if line.name == "near_collision")
        assert (line.note, line.rows, line.missing_rows) == ("unknown: no lidar", 0, 0)
        refusing = parse_mixture(MIXTURE.format(more='shortfall = "refuse"'), where="mix.toml")
        with pytest.raises(MixtureError, match=r"near_collision wants 40\.0%, and is unknown in"):
            plan_panel(store.connection, refusing, known)


def test_limiter_without_lidar_limits_only_speed():
    limits = Limits.of(BLIND.task)
    fast = np.array([[0.5, 0.0], [9.0, 0.0]])
    limited = limit(limits, fast, np.zeros((2, 0)), np.array([[0.5, 0.0], [1.0, 0.0]]))
    assert limited.rule.tolist() == [NONE, SPEED]
    assert limited.command[:, 0].tolist() == [0.5, limits.fastest[0]]


def test_proposal_without_lidar_is_ingestible(drives, tmp_path):
    profile = tmp_path / "mine.toml"
    proposed(drives / "blind", profile, codes=(0, 3))
    assert "sectors = 0  # no lidar" in profile.read_text()
    query = "SELECT rows_held FROM coverage_by_condition WHERE condition = 'near_collision'"
    with ingested(drives / "blind", profile, tmp_path / "store") as opened:
        assert opened.sql(query).fetchall() == [(None,)]
