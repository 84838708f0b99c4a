"""Check missions files in the twin: the missions that they order, and rejected orders."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from restock.cli import main
from restock.errors import ConfigError
from restock.replay.fleet.missions_file import MissionOrder, MissionsFile
from restock.train.dqn.config import parse_config
from restock.train.feed.practice import make_twin
from restock.train.judge.comparability import kind_of
from restock.train.prepare import prepare_new
from restock.train.twin.env.episode_queue import EpisodeQueue, MissionArms, MissionOrders
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.floors.layout import default_warehouse
from restock.train.twin.floors.planner import planners
from restock.train.twin.physics.episode import EpisodeSpec, draw_episode
from restock.train.twin.physics.perturbation import Perturbation
from restock.train.twin.recording.fleet import MAX_DRIVEN, OrderedMissions
from restock.train.twin.recording.recorder import RecordingPlan

FLOOR = default_warehouse()
PLANNERS = planners([FLOOR])
SLIP = MissionOrder(kind="wheel_slip", missions=4)
THERE = MissionOrder(kind="nominal", missions=1, zone="aisle_3_east")


def orders(*given: MissionOrder) -> MissionOrders:
    return MissionOrders(given, [FLOOR], PLANNERS, where="next.toml")


def ordered_missions(*given: MissionOrder, seed: int = 0) -> OrderedMissions:
    file = MissionsFile(missions=given)
    return OrderedMissions(orders(*given), file, seed, "handover", Perturbation())


def test_mission_of_a_zone_passes_through_it() -> None:
    made = orders(SLIP, THERE)
    specs = [made.spec(1, seed) for seed in range(6)]
    assert len(set(specs)) == 6
    assert specs == [made.spec(1, seed) for seed in range(6)]
    for spec in specs:
        assert spec == EpisodeSpec("nominal", spec.seed)
        plan = draw_episode(spec, FLOOR, PLANNERS[0]).plan_m
        fine = plan[:-1, None] + np.linspace(0, 1, 50)[:, None] * np.diff(plan, axis=0)[:, None]
        x, y = fine.reshape(-1, 2).T
        assert "aisle_3_east" in FLOOR.zone_of(x, y)
    assert made.shares.tolist() == [0.8, 0.2]


@pytest.mark.parametrize(
    ("order", "message"),
    [
        (MissionOrder(kind="rain", missions=1), "no missions of kind 'rain'"),
        (MissionOrder(hours=3.0), "hours of logging"),
        (MissionOrder(kind="nominal", missions=1, zone="roof"), "zone 'roof'"),
        (MissionOrder(kind="nominal", missions=1, layout="hall"), "floor 'hall'"),
    ],
)
def test_orders_the_twin_lacks_are_rejected_by_name(order: MissionOrder, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as error:
        orders(SLIP, order)
    assert "missions[1]" in str(error.value)


def test_rounds_continue_until_enough_missions_count() -> None:
    missions = ordered_missions(SLIP, MissionOrder(kind="near_collision", missions=2))
    driven = []
    for one_round in missions.rounds():
        for number, mission in enumerate(one_round):
            driven.append(mission)
            # Every second wheel slip occurs, and no near collision does.
            missions.note(mission, observed=mission.order == 0 and number % 2 == 0)
    kinds = [mission.spec.condition for mission in driven]
    assert kinds.count("near_collision") == MAX_DRIVEN * 2
    assert missions.observed[0] == 4 or kinds.count("wheel_slip") == MAX_DRIVEN * 4
    assert len({mission.spec.seed for mission in driven}) == len(driven)
    assert not missions.owed()


def test_robot_tag_selects_missions() -> None:
    file = MissionsFile(missions=(SLIP, MissionOrder(kind="nominal", missions=1, robot="amr_7")))
    with pytest.raises(ConfigError, match="amr_7: no robot was given"):
        RecordingPlan(missions=file).orders()
    assert RecordingPlan(missions=file, tags={"robot": "amr_7"}).kinds == {
        "wheel_slip": 4,
        "nominal": 1,
    }
    assert RecordingPlan(missions=file, tags={"robot": "amr_8"}).orders() == [SLIP]


def test_dry_run_and_invalid_file_write_nothing(tmp_path, shell):
    out, file = tmp_path / "next.mcap", tmp_path / "next.toml"
    file.write_text('[[missions]]\nkind = "wheel_slip"\nmissions = 3\n')
    args = ["twin", "record", "--out", str(out), "--missions", str(file)]
    plan = shell.json(*args, "--dry-run")
    assert plan["orders"] == [{"kind": "wheel_slip", "missions": 3}]
    assert plan["conditions"] == {"wheel_slip": 3}
    file.write_text('[[missions]]\nkind = "wheel_slip"\nmissions = 3\nzone = "roof"\n')
    assert "zone 'roof'" in shell.err(*args)
    assert "restock coverage gaps" in shell.err(
        "twin", "record", "--out", out, "--missions", tmp_path / "none.toml"
    )
    assert not out.exists()


def test_record_counts_missions_by_observed_condition(tmp_path, shell):
    file = tmp_path / "next.toml"
    file.write_text('[[missions]]\nkind = "nominal"\nmissions = 1\n')
    out = tmp_path / "next.mcap"
    done = shell.json("twin", "record", "--out", out, "--missions", file)
    assert done["ordered"] == done["missions"] == done["met"] == {"nominal": 1}
    assert out.stat().st_size == done["size_bytes"]


@pytest.mark.slow
def test_recorded_missions_close_coverage_gaps(tmp_path, shell):
    """Record the missing missions and measure again: gaps are closed or within their intervals."""

    run = shell.json
    store, requested = str(tmp_path / "store"), tmp_path / "asked.toml"
    requested.write_text(
        'max_replays_per_row = 20\nplanned_draws = 64000\n'
        '[[strata]]\nname = "nominal"\nunit = "episode"\nshare = 0.5\n'
        '[[strata]]\nname = "wheel_slip"\nunit = "episode"\nshare = 0.5\n'
        '[[strata]]\nname = "rest"\nwhere = "true"\nshare = 0.0\npriority = 5000\n'
    )  # fmt: skip
    first = ["--missions", "24", "--conditions", "nominal=.8,wheel_slip=.2"]
    run("twin", "record", "--out", str(tmp_path / "first.mcap"), *first)
    assert main(["ingest", str(tmp_path / "first.mcap"), "--store", store]) == 0
    gaps = ["coverage", "gaps", store, "--mixture", str(requested), "--thresholds", "none"]
    before = run(*gaps, "--missions-out", str(tmp_path / "next.toml"))
    missing = {gap["cell"]: gap for gap in before["gaps"]}
    assert "wheel_slip" in missing
    run("twin", "record", "--out", str(tmp_path / "next.mcap"), "--missions",
        str(tmp_path / "next.toml"), "--start", "2026-03-03")  # fmt: skip
    assert main(["ingest", str(tmp_path / "next.mcap"), "--store", store]) == 0
    after = {gap["cell"]: gap for gap in run(*gaps)["gaps"]}
    slip = missing["wheel_slip"]
    driven = sum(o["missions"] for o in before["plan"]["orders"])
    added = slip["missing"] - after.get("wheel_slip", {"missing": 0})["missing"]
    assert "wheel_slip" not in after or added / driven >= slip["rate_low"] * 0.8
    assert added > 0.5 * slip["missing"]


def draw_specs(
    missions: tuple[MissionOrder, ...], share: float, count: int = 400
) -> list[EpisodeSpec]:
    """Return the episodes that one of two environments starts."""
    ordered = orders(*missions) if missions else None
    conditions = {"nominal": 1.0}
    arms = MissionArms([FLOOR], PLANNERS, conditions, orders=ordered, orders_share=share)
    queue = EpisodeQueue(2, arms, seed=5)
    return [queue.next(1)[0] for _ in range(count)]


def test_missions_share_sets_share_of_episodes() -> None:
    missions = (SLIP, MissionOrder(kind="blocked_aisle", missions=12))
    plain, mixed = draw_specs((), 0.5), draw_specs(missions, 0.5)
    kinds = Counter(spec.condition for spec in mixed)
    assert kinds["blocked_aisle"] == pytest.approx(150, abs=30)
    assert kinds["wheel_slip"] == pytest.approx(50, abs=22)
    assert mixed == draw_specs(missions, 0.5)
    assert set(mixed) - set(plain) == {s for s in mixed if s.condition != "nominal"}
    assert all(spec.condition != "nominal" for spec in draw_specs(missions, 1.0))


def test_run_config_keeps_missions_as_practice(tmp_path: Path) -> None:
    file = tmp_path / "next.toml"
    file.write_text('[[missions]]\nkind = "wheel_slip"\nmissions = 3\nzone = "cross_east"\n')
    settings = [f"env.missions={str(file)!r}", "env.missions_share=0.25"]
    prepared = prepare_new(tmp_path / "run", None, None, settings)
    file.unlink()  # the run keeps a copy, since the file may change
    kept = prepared.document["config"]["env"]
    assert kept["missions"][0]["zone"] == "cross_east"
    assert parse_config(prepared.document["config"], where="kept") == prepared.config
    assert kind_of("config.env.missions") == "practice"
    twin = make_twin(prepared.config, prepared.profile, 2)
    assert isinstance(twin, WarehouseVectorEnv)
    kinds = {twin.queue.next(0)[0].condition for _ in range(40)}
    assert "wheel_slip" in kinds
