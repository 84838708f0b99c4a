"""Diagnose rows before training: planted faults are named, sound rows are healthy."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow.parquet as pq
import pytest
from support.panels import EVERY, NO_SPLIT, panel_of
from support.paths import ROOT
from support.stores import TASK, hindsight_profile, recording_transitions, write_store

from restock.arrays import Ints
from restock.cli import main
from restock.errors import PanelError
from restock.ingest.pipeline import ingest
from restock.ingest.profile.profile import load_profile, profile_toml
from restock.ingest.store.transitions import replaced
from restock.ingest.store.writer import StoreWriter
from restock.ingest.task.task import nearest_action
from restock.replay.panel.panel import HEADER, META, FileRecord, Panel, seal
from restock.replay.store.store import Store
from restock.stats import ConfidenceInterval
from restock.train.judge import before_training, fed_rows, row_checks
from restock.train.judge.answers import ACTION_TURN, GAIN, RELATIONS, Answer
from restock.train.judge.before_training import (
    OpenedRows,
    RowDiagnosis,
    diagnose_rows,
    open_rows,
)
from restock.train.judge.beside import PROPOSED, tallies
from restock.train.judge.causes import findings
from restock.train.judge.diagnose import Diagnosis, with_rows
from restock.train.judge.fed_rows import Comparison, FedRows, correct_over_parts, drive_twin, judged
from restock.train.judge.row_checks import values
from restock.train.twin.env.drivers import RandomPolicy
from restock.train.twin.floors.floors import open_floors

Plant = Callable[[FedRows], FedRows]


@pytest.fixture(scope="module")
def logs() -> FedRows:
    """Return sound logs: episodes of the twin with another seed than the `twin` fixture."""
    return _drive(seed=7)


@pytest.fixture(scope="module")
def twin() -> FedRows:
    return _drive(seed=1)


def _drive(seed: int) -> FedRows:
    profile = load_profile("warehouse_amr")
    return drive_twin(profile.task, profile.conditions, seed=seed, robots=8, steps=300)


def _mirror_turns(rows: FedRows) -> FedRows:
    """Exchange left and right in actions and in the previous actions of observations."""
    table = [tuple(action) for action in rows.task.actions]
    other = np.array([table.index((speed, -turn if turn else turn)) for speed, turn in table])
    return _set_actions(rows, other[rows.action])


def _set_actions(rows: FedRows, action: Ints) -> FedRows:
    """Replace actions (N,), also as previous actions in observations."""
    first, count = rows.task.observation_names.index("previous_action_0"), len(rows.task.actions)
    held, before = np.eye(count, dtype=np.float32)[action], rows.joined.nonzero()[0]
    observation, after = rows.observation.copy(), rows.next_observation.copy()
    observation[before, first : first + count] = held[before - 1]
    after[:, first : first + count] = held
    return replace(rows, action=action, observation=observation, next_observation=after)


def _delay_actions(rows: FedRows) -> FedRows:
    place, known = rows.before(2)
    return _set_actions(rows, np.where(known, rows.action[place], 0))


def _change_entries(rows: FedRows, change: Callable[..., None], *names: str) -> FedRows:
    """Apply `change` to the observations; it also gets the column indices of `names`."""
    places = [rows.task.observation_names.index(name) for name in names]
    made = [rows.observation.copy(), rows.next_observation.copy()]
    for held in made:
        change(held, *places)
    return replace(rows, observation=made[0], next_observation=made[1])


def _add_entry(rows: FedRows, to: str, of: str, by: float) -> FedRows:
    def change(held: Any, at: int, other: int) -> None:
        held[:, at] += by * held[:, other]

    return _change_entries(rows, change, to, of)


def _change_gyroscope(rows: FedRows, by: Any, bias: float = 0.0) -> FedRows:
    def change(held: Any, gyro: int, slip: int) -> None:
        read = by * held[:, gyro] + bias
        held[:, slip] += held[:, gyro] - read
        held[:, gyro] = read

    return _change_entries(rows, change, "gyro_yaw_rate", "slip_yaw_rate")


def _shuffle(values: Any) -> Any:
    return np.random.default_rng(0).permutation(values)


def _tilt(held: Any, at: int) -> None:
    held[:, at] += 0.1  # in units of 5 m/s2


def _repeat_episodes(rows: FedRows, from_step: int = 0) -> FedRows:
    again: Any = np.flatnonzero((rows.episode < 3) & (rows.step >= from_step))
    both = rows.take(np.append(np.arange(len(rows)), again))
    both.episode[len(rows) :] += rows.episode.max() + 1
    both.step[len(rows) :] -= from_step
    return both


def _change_lidar(rows: FedRows, change: Callable[..., Any]) -> FedRows:
    """Apply `change` to clearances (N, S) in m, which observations hold as square roots."""
    first = rows.task.observation_names.index("clearance_-175deg")
    most, count = rows.task.range_max_m, rows.task.sectors

    def put(held: Any) -> None:
        sectors = slice(first, first + count)
        seen = change(held[:, sectors] ** 2 * most)
        held[:, sectors] = np.sqrt(np.clip(seen / most, 0, 1))

    made = _change_entries(rows, put)
    before, known = made.before(1)
    closing = made.sectors() - made.sectors()[before] * known[:, None]
    made.observation[known, first + count : first + 2 * count] = closing[known]
    made.next_observation[:, first + count :][:, :count] = made.sectors(after=True) - made.sectors()
    return made


def _cut_episodes(rows: FedRows) -> FedRows:
    """Cut the last second of each episode and mark its new end as terminated."""
    following, known = rows.before(-5)
    cut = rows.take(known & (rows.episode[following] == rows.episode))
    return replace(cut, terminated=cut.last)


PLANTED: dict[str, tuple[Plant, str]] = {
    "gyroscope in degrees": (lambda rows: _change_gyroscope(rows, 180 / np.pi), "SENSOR_SCALED"),
    "gyroscope with a bias": (lambda rows: _change_gyroscope(rows, 1, 0.1), "SENSOR_BIASED"),
    "heading 8 degrees off": (
        lambda r: _add_entry(r, "lateral_speed", "localised_speed", 0.14), "SENSOR_TURNED"),
    "pose .2 m ahead of the centre": (
        lambda rows: _add_entry(rows, "lateral_speed", "gyro_yaw_rate", 0.2), "SENSOR_OFF_CENTRE"),
    "tilted IMU": (lambda rows: _change_entries(rows, _tilt, "accel_x"), "SENSOR_BIASED"),
    "parts of episodes repeated": (
        lambda r: _repeat_episodes(r, from_step=10), "EPISODES_REPEATED"),
    "lidar ranges halved": (lambda r: _change_lidar(r, lambda seen: seen / 2), "LIDAR_SCALED"),
    "left and right exchanged in half of the rows": (
        lambda r: _set_actions(
            r, np.where(_shuffle(r.step % 2 > 0), _mirror_turns(r).action, r.action)),
        "ACTIONS_MIXED"),
    "left and right exchanged": (_mirror_turns, "ACTIONS_MIRRORED"),
    "actions .4 s late": (_delay_actions, "ACTIONS_SHIFTED"),
    "actions changed after ingest": (
        lambda rows: replace(rows, action=_mirror_turns(rows).action), "ACTIONS_CHANGED"),
    "rewards doubled": (lambda rows: replace(rows, reward=2 * rows.reward), "REWARD_SCALED"),
    "rewards of other rows": (lambda rows: replace(rows, reward=_shuffle(rows.reward)), "REWARD_"),
    "terminations removed": (
        lambda rows: replace(rows, terminated=rows.terminated & False), "TERMINATIONS_LOST"),
    "time-outs as terminations": (_cut_episodes, "TERMINATIONS_WRONG"),
    "next observations of other rows": (
        lambda rows: replace(rows, next_observation=_shuffle(rows.next_observation)), "ROWS_APART"),
    "observations of the next step": (
        lambda rows: replace(rows, observation=rows.next_observation), "FUTURE_IN_OBSERVATION"),
    "episodes repeated": (_repeat_episodes, "EPISODES_REPEATED"),
}  # fmt: skip


@pytest.mark.parametrize("with_twin", [True, False])
def test_sound_rows_are_healthy(logs: FedRows, twin: FedRows, with_twin: bool) -> None:
    found = diagnose_rows(logs, twin if with_twin else None, "there is none")
    assert (found.verdict, found.findings) == ("HEALTHY", [])
    assert [row.note for row in found.not_run if row.check == "twin"] == (
        [] if with_twin else ["there is none"]
    )


@pytest.mark.parametrize("fault", PLANTED)
def test_planted_fault_is_named(logs: FedRows, twin: FedRows, fault: str) -> None:
    plant, cause = PLANTED[fault]
    for against in (twin, None):
        if against is None and cause in ("LIDAR_SCALED", "SENSOR_BIASED"):
            continue  # without a twin, the rows contain no reference for a distance or a zero
        found = diagnose_rows(plant(logs), against, "there is none")
        assert found.verdict == "BUFFER"
        assert found.findings[0].cause.startswith(cause)
        rows = {row.check: row for row in found.comparisons}
        assert all(rows[check].status == "off" for check in _evidence(found))


def _evidence(found: RowDiagnosis) -> list[str]:
    return [check for one in found.findings for check in one.evidence]


@pytest.mark.parametrize(("high", "named"), [(-0.9, "MIRRORED"), (0.5, "MIXED")])
def test_mirrored_needs_interval_below_zero(high: float, named: str) -> None:
    answers = []
    for relation in RELATIONS:
        off = relation.x == ACTION_TURN
        value, most = (-1.5, high) if off else (1.0, 1.1)
        gain = judged(
            f"gain: {relation.name}", "", "ratio", ConfidenceInterval(value, value - 2, most),
            logs=value, twin=1.0, least=1 / GAIN, most=GAIN, logs_rows=600,
        )  # fmt: skip
        assert gain.off is off
        answers.append(Answer(relation, [gain], value, 0.0))
    (found,) = findings(answers, [], TASK)
    assert found.cause == f"ACTIONS_{named}"
    assert not re.search(r"[2-9]\d\d%|1[1-9]\d%", found.text)  # no share above 1


@pytest.mark.parametrize(
    ("kind", "tagged", "part"),
    [
        ("recordings", False, "r2"),
        ("robots", True, "robot r2"),
        ("groups of recordings", False, "m28 and the next 10"),
    ],
)
def test_fault_of_one_robot_names_its_recordings(kind, tagged, part, logs, twin):
    """Check that a fault in a third of the rows names the robot's tag or its recordings."""
    owner = logs.episode % 3
    third = np.array([f"r{one}" for one in owner])
    fleet = replace(logs, recording=third, logged_ns=1_000 * owner + logs.episode)
    if kind != "recordings":
        robot = third if tagged else np.full(len(logs), "")
        fleet = replace(fleet, recording=np.array([f"m{e:02}" for e in logs.episode]), robot=robot)
    sound = diagnose_rows(fleet, twin)
    assert sound.verdict == "HEALTHY"
    (compared,) = [row for row in sound.comparisons if row.check == "recordings"]
    several = len(np.unique(fleet.recording))
    assert (
        compared.note == f"3 {kind} with 500 rows were compared: {several} of {several} recordings"
    )
    found = diagnose_rows(_change_gyroscope(fleet, np.where(third == "r2", 1.5, 1.0)), twin)
    assert [one.cause for one in found.findings] == ["SENSOR_SCALED"]
    assert f"in 1 of 3 {kind} ({part}): the scale of the logs' gyroscope is 1." in (
        found.findings[0].text
    )
    assert all(check.endswith(f", {part}") for check in found.findings[0].evidence)
    assert {row.check for row in found.comparisons if row.off} >= {*_evidence(found), "recordings"}


def _alternate_drivers(rows: FedRows, *names: str) -> Any:
    return np.array(names)[rows.episode // 3 % 2]


def _plant_in_one_robot(rows: FedRows, plant: Plant) -> FedRows:
    """Plant a fault in the second of three robots, each with two drivers."""
    robot = np.array([f"r{one}" for one in rows.episode % 3])
    driver = _alternate_drivers(rows, "planner", "operator")

    def without_proposal(held: Any, *places: int) -> None:
        held[np.ix_(driver == "operator", places)] = 0

    rows = _change_entries(rows, without_proposal, "nav_known", "nav_speed", "nav_yaw_rate")
    counted = np.full((len(rows), 2), len(rows))
    rows = replace(rows, recording=robot, robot=robot, driver=driver, counted=counted)
    faulty = plant(rows)

    def of_both(name: str) -> Any:
        sound, new = getattr(rows, name), getattr(faulty, name)
        return np.where((robot == "r1").reshape(-1, *[1] * (sound.ndim - 1)), new, sound)

    names = ("observation", "next_observation", "pose", "driver", "counted")
    return replace(rows, **{name: of_both(name) for name in names})


OF_ONE: dict[str | None, tuple[Plant, str]] = {
    None: (lambda rows: rows, ""),
    "scaled wheels": (
        lambda rows: _add_entry(rows, "wheel_speed", "wheel_speed", -0.08),
        "the scale of the logs' wheels (speed) is 0.92"),
    "short lidar ranges": (
        lambda rows: _change_lidar(rows, lambda seen: seen - 0.25), "lidar differ by -0.2"),
    "blind lidar sectors": (
        lambda rows: _change_lidar(rows, lambda seen: np.where(np.arange(36) < 9, 4.0, seen)),
        "racks and walls in 25% of its sectors (degrees from ahead: -175,"),
    "shifted pose": (
        lambda r: replace(r, pose=r.pose + np.outer(r.episode % 2, [1, 1, 0])),
        "lidar does not see the racks that should be near the pose"),
    "exchanged drivers": (
        lambda rows: replace(rows, driver=_alternate_drivers(rows, "operator", "planner")),
        "driven like another policy"),
    "lost rows": (
        lambda rows: replace(rows, counted=np.add(rows.counted, [40, 0])),
        "of the rows that ingest wrote for these recordings are gone"),
}  # fmt: skip


@pytest.mark.parametrize("fault", OF_ONE)
def test_fault_of_one_robot_is_the_only_finding(logs, twin, fault):
    plant, message = OF_ONE[fault]
    fleet, floors = _plant_in_one_robot(logs, plant), open_floors("default")
    found = diagnose_rows(fleet, twin, files={"r1": "monday.mcap"}, floors=floors)
    texts = [one.text for one in found.findings]
    start = "in 1 of 3 robots (robot r1: monday.mcap): "
    assert all(text.startswith(start) for text in texts)
    assert [message in text for text in texts] == [True] * (fault is not None)


def _change_series(rows: FedRows, name: str, change: Callable[..., Any]) -> FedRows:
    """Change one entry over time, and next observations accordingly."""
    at = rows.task.observation_names.index(name)
    observation, after = rows.observation.copy(), rows.next_observation.copy()
    observation[:, at] = change(observation[:, at])
    following, known = rows.before(-1)
    after[known, at] = observation[following[known], at]
    return replace(rows, observation=observation, next_observation=after)


def _continue_at_ends(rows: FedRows) -> FedRows:
    ends, begins = np.flatnonzero(rows.last), np.flatnonzero(np.append(True, rows.last[:-1]))
    after = rows.next_observation.copy()
    after[ends] = rows.observation[np.roll(begins, -1)]
    return replace(rows, next_observation=after)


def _repeat_at_ends(rows: FedRows) -> FedRows:
    after = rows.next_observation.copy()
    after[rows.last] = rows.observation[rows.last]
    return replace(rows, next_observation=after)


def _copy_command(rows: FedRows) -> FedRows:
    """Replace the wheel speed by the command, in observations and next observations."""
    at = rows.task.observation_names.index("wheel_speed")
    observation, after = rows.observation.copy(), rows.next_observation.copy()
    after[:, at] = rows.command()[:, 0]
    before, known = rows.before(1)
    observation[known, at] = after[before[known], at]
    return replace(rows, observation=observation, next_observation=after)


def _hold_wrong_values(rows: FedRows) -> FedRows:
    """Hold each gyroscope value for four steps, with values of other rows."""
    row = np.arange(len(rows)) // 4 * 4
    read = _change_series(rows, "gyro_yaw_rate", lambda one: np.roll(one, 99)[row])
    for wrong, right in ((read.observation, rows.observation),
                         (read.next_observation, rows.next_observation)):  # fmt: skip
        gyro, slip = map(rows.task.observation_names.index, ("gyro_yaw_rate", "slip_yaw_rate"))
        wrong[:, slip] += right[:, gyro] - wrong[:, gyro]  # the wheels are unchanged
    return read


def _drop_returns(seen: Any) -> Any:
    return np.where((seen > 3.99) & (np.arange(36) % 9 == 0), 0.0, seen)


def _cut_at_new_goals(rows: FedRows) -> FedRows:
    """Make episodes of one robot end as truncated, with the next one a step later."""
    begins = (1 + np.cumsum(rows.robot == "r1")) * round(1e9 * rows.task.control_period_s)
    return replace(rows, logged_ns=begins, terminated=rows.terminated & False,
                   truncated=rows.last)  # fmt: skip


def _follow_proposals(rows: FedRows) -> FedRows:
    fastest_mps, fastest_radps = np.abs(rows.task.actions).max(axis=0)  # the units of observations
    speed_mps = rows.now("nav_speed") * fastest_mps
    return _set_actions(
        rows, nearest_action(rows.task, speed_mps, rows.now("nav_yaw_rate") * fastest_radps)[0]
    )


def _clip(held: Any, at: int) -> None:
    held[:, at] = held[:, at].clip(-0.5, 0.5)


def _split_episodes(rows: FedRows) -> FedRows:
    half = np.bincount(rows.episode)[rows.episode] // 2
    second = rows.step >= half
    return replace(rows, episode=2 * rows.episode + second, step=rows.step - second * half)


PART_OF: dict[str | None, tuple[Plant, str]] = {
    None: (lambda rows: rows, ""),
    "saturated wheel speed": (
        lambda r: _change_entries(r, _clip, "wheel_speed"), "wheels (speed) is never beyond 0.5"),
    "rounded wheel speed": (
        lambda r: _change_series(r, "wheel_speed", lambda one: np.round(one, 1)),
        "wheels (speed) has few different values"),
    "zero wheel speed": (
        lambda r: _change_series(r, "wheel_speed", lambda one: one * (np.arange(len(r)) % 9 > 0)),
        "wheels (speed) reads 0 in 11%"),
    "held wheel speed": (
        lambda r: _change_series(
            r, "wheel_speed", lambda one: one[np.arange(len(r)) - np.arange(len(r)) % 4]),
        "wheels (speed) keeps its value in 7"),
    "late wheel speed": (
        lambda r: _change_series(
            r, "wheel_speed", lambda one: np.where(r.episode % 8 < 4, np.roll(one, 5), one)),
        "wheels (speed) is 1 s (5 steps) late"),
    "jumps of the pose": (
        lambda r: _change_series(r, "localised_speed", lambda one: one + 2.5 * (r.step % 20 == 9)),
        "the logs' pose has single values that are far off"),
    "wheel speed is the command": (_copy_command, "wheels (speed) are exactly the command"),
    "opposite sign": (
        lambda r: _change_gyroscope(r, np.where(r.episode % 8 < 4, -1.0, 1.0)),
        "the sign of the logs' gyroscope is opposite"),
    "wrong gyroscope values": (_hold_wrong_values, "the logs' gyroscope does not follow"),
    "lidar without returns": (lambda r: _change_lidar(r, _drop_returns), "the logs' lidar reads 0"),
    "goals replaced early": (
        _cut_at_new_goals, "another goal is in force before the goal is reached"),
    "actions are proposals": (
        _follow_proposals, "of the actions of 'planner' are navigation's proposals"),
    "observation repeated at ends": (_repeat_at_ends, "it repeats the row's own observation"),
    "rewards of the previous row": (
        lambda r: replace(r, reward=np.where(r.step % 3, r.reward, np.roll(r.reward, 1))),
        "are not exactly the task's rewards"),
    "next episode at ends": (
        _continue_at_ends, "the last next observation does not follow from its row"),
    "split episodes": (_split_episodes, "stop where another episode begins"),
}  # fmt: skip


@pytest.mark.parametrize("fault", PART_OF)
def test_partial_fault_is_found_beside_other_robots(logs, twin, fault, monkeypatch):
    monkeypatch.setattr(before_training, "MIN_ROWS", 300)
    plant, message = PART_OF[fault]
    robot = np.array([f"r{one}" for one in logs.episode % 4])
    driver = np.full(len(logs), "planner")
    stamp_ns = 10**12 * (1 + logs.episode) + 10**9 * logs.step
    fleet = replace(logs, recording=robot, robot=robot, driver=driver, logged_ns=stamp_ns)
    faulty = plant(fleet)
    parts = [(faulty if name == "r1" else fleet).take(robot == name) for name in np.unique(robot)]
    together = replace(parts[0], **{
        name: np.concatenate([getattr(one, name) for one in parts])
        for name, value in vars(parts[0]).items()
        if isinstance(value, np.ndarray) and name in type(parts[0]).__dataclass_fields__
    })  # fmt: skip
    together.episode[:] += 1000 * np.unique(together.robot, return_inverse=True)[1]
    found = diagnose_rows(together, twin)
    texts = [one.text for one in found.findings]
    assert [text for text in texts if not text.startswith("in 1 of 4 robots (robot r1)")] == []
    assert [text for text in texts if message in text] or fault is None, texts


def test_proposals_are_compared_in_observation_units(logs: FedRows) -> None:
    """Compare with a robot of a quarter of the speed, since observations are scaled by speed."""
    slow = tuple((speed / 4, turn / 4) for speed, turn in logs.task.actions)
    driven = replace(logs, driver=np.full(len(logs), "planner"))
    shares = [
        [one.share for one in tallies(replace(driven, task=task)) if one.kind == PROPOSED]
        for task in (logs.task, msgspec.structs.replace(logs.task, actions=slow))
    ]
    assert shares[0] == shares[1] != []


def test_checks_are_corrected_for_number_of_parts():
    interval = ConfidenceInterval(1.2, 1.09, 1.31)
    row = judged("gain: x", "", "ratio", interval, logs=1.2, twin=1.0, most=1.08, logs_rows=9)
    sound = judged("gain: x", "", "ratio", ConfidenceInterval(1.0, 0.9, 1.1), logs=1.0, twin=1.0,
                   most=1.08, logs_rows=9)  # fmt: skip
    correct_over_parts([[row]])
    assert row.off
    parts = [[row], *([replace(sound)] for _ in range(19))]
    correct_over_parts(parts)
    assert [one.status for (one,) in parts] == ["undecided", *["ok"] * 19]


@pytest.fixture(scope="module")
def tuesday(tmp_path_factory: pytest.TempPathFactory) -> OpenedRows:
    """Return logged rows with their poses, on the twin's own floor."""
    store = tmp_path_factory.mktemp("tuesday") / "store"
    ingest(
        ROOT / "sample_logs/amr_tuesday", load_profile("warehouse_amr"), store=StoreWriter(store)
    )
    return open_rows(store)


def test_moved_racks_are_reported(tuesday):
    def judged_on(floor: str, east_m: float) -> RowDiagnosis:
        assert tuesday.rows.pose is not None
        moved = replace(tuesday.rows, pose=tuesday.rows.pose + np.array([east_m, 0.0, 0.0]))
        return diagnose_rows(moved, None, floors=open_floors(floor))

    assert judged_on("default", 0.0).findings == []
    (found,) = judged_on("default", 1.0).findings
    assert found.cause == "FLOOR_MOVED"
    assert "the lidar sees racks 1.0 m east of where 'default' has them" in found.text
    other = judged_on("generated:10", 0.0)
    assert other.findings == []
    (row,) = [row for row in other.not_run if row.check == "floor"]
    assert "these logs are of another floor" in row.note


def test_unpursued_goals_are_not_a_scaled_plan(tuesday):
    rows = tuesday.rows

    def away(held: Any, place: int) -> None:  # the robot drives away from its goal
        held[rows.episode % 2 == 0, place] = 0.95 - held[rows.episode % 2 == 0, place]

    found = diagnose_rows(_change_entries(rows, away, "goal_distance"), None)
    assert "GOALS_OF_OTHERS" in {one.cause for one in found.findings}
    assert not any("plan is" in one.text for one in found.findings)
    (one,) = [one for one in found.findings if one.cause == "GOALS_OF_OTHERS"]
    assert re.search(r"in [3-6]\d% of the missions the robot drives and its goal", one.text)


@pytest.mark.parametrize("failed", [0.0, 1.0])
def test_conditions_chosen_by_outcome_are_reported(logs, failed):
    """Check the selection bias if near collisions are kept only when they end in failure."""
    near = logs.episode % 3 == 0
    held = np.empty(len(logs), object)
    held[:] = [({"near_collision"} if one else set(), {"closing_traffic"}) for one in near]
    rows = replace(logs, held=held, success=np.where(near, 1.0 - failed, 1.0))
    causes = [one.cause for one in diagnose_rows(rows, None).findings]
    assert causes == (["CHOSEN_ON_OUTCOME"] if failed else [])


@pytest.mark.long
@pytest.mark.parametrize("logged", ["ice", "random driver"])
def test_ice_and_random_driving_are_not_faults(twin, logged, monkeypatch):
    if logged == "ice":
        monkeypatch.setattr(fed_rows, "KINDS", ("nominal", "wheel_slip"))
    else:
        monkeypatch.setattr(fed_rows, "Handover", lambda *_: RandomPolicy(seed=9))
    found = diagnose_rows(_drive(seed=9), twin)
    assert found.findings == []
    assert not any(row.off for row in found.comparisons)


def test_few_rows_are_not_called_healthy(logs: FedRows, twin: FedRows) -> None:
    few = logs.take(np.arange(len(logs)) < 200)
    assert diagnose_rows(few, twin).verdict != "HEALTHY"


def test_small_spread_in_one_episode_is_undecided(logs: FedRows, twin: FedRows) -> None:
    """Accept sensors with little noise, as of an ideal simulator or an empty floor."""
    place = logs.task.observation_names.index
    still = logs.observation.copy()
    still[:, place("lateral_speed")] *= 0.001
    calm = still.copy()
    calm[:, place("accel_x")] *= 0.001
    spread = {
        name: {row.check: row.status for row in values(rows, twin)}
        for name, rows in {
            "still": replace(logs, observation=still),
            "calm": replace(logs, observation=calm),
            "calm in one": replace(logs, observation=calm).take(logs.episode == logs.episode[0]),
        }.items()
    }
    assert spread["still"]["spread: lateral_speed"] == "ok"
    assert spread["calm"]["spread: accel_x"] == "off"
    assert spread["calm in one"]["spread: accel_x"] == "undecided"


def test_diagnose_reports_findings_for_noise(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Diagnose rows of pure noise."""
    store = write_store(tmp_path / "store", [recording_transitions(index) for index in (1, 2)])
    words = ["diagnose", str(store), "--no-twin"]
    profile = tmp_path / "profile.toml"
    assert main(words) == 2
    assert "no shipped profile has this task" in capsys.readouterr().err
    profile.write_text(
        profile_toml(msgspec.structs.replace(load_profile("warehouse_amr"), task=TASK))
    )
    assert main([*words, "--profile", str(profile), "--check"]) == 1
    shown = capsys.readouterr().out
    assert "BUFFER" in shown
    assert "not run: twin: it was not requested" in shown
    assert main([*words, "--profile", str(profile), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["verdict"] == "BUFFER"
    assert {row["status"] for row in document["comparisons"]} >= {"off", "not run"}


def run_checks(opened: OpenedRows) -> list[Comparison]:
    return [one.of(opened.rows) for one in opened.checks]


def test_labels_and_ends_are_recomputed_from_signals(tmp_path: Path) -> None:
    logs, store = ROOT / "sample_logs/amr_tuesday", StoreWriter(tmp_path / "store")
    ingest(logs, load_profile("warehouse_amr"), store=store)
    as_stored = open_rows(tmp_path / "store")
    assert (np.diff(as_stored.rows.logged_ns)[as_stored.rows.joined[1:]] > 0).all()
    compared = {row.check: row for row in run_checks(as_stored)}
    assert len(compared) > 3
    assert {row.status for row in compared.values()} <= {"ok", "not run"}
    assert compared["terminations"].status == "ok"

    (row,) = store.live().to_pylist()
    rows = store.rows(row["recording_id"], row["ingest_id"])
    given = rows["conditions"].to_pylist()
    changed = {
        "conditions": [names or ["blocked_aisle"] for names in given],
        "terminated": [not ended for ended in rows["terminated"].to_pylist()],
    }
    other = StoreWriter(tmp_path / "other")
    other.write(store.live(row["recording_id"]), replaced(rows, changed))
    opened = open_rows(tmp_path / "other")
    off = [row.check for row in run_checks(opened) if row.off]
    assert off == ["labels: blocked_aisle", "terminations"]
    found = diagnose_rows(opened.rows, None, "there is none", more=opened.checks).findings
    assert {"LABELS_WRONG", "TERMINATIONS_LOST"} <= {one.cause for one in found}


def test_labels_unknown_in_hindsight_are_not_checked(tmp_path: Path) -> None:
    profile = load_profile(hindsight_profile(tmp_path))
    ingest(ROOT / "sample_logs/amr_tuesday", profile, store=StoreWriter(tmp_path / "store"))
    rule = {"name": "on_the_plan", "sql": "plan_gap_m > 0", "let": {}}
    on_the_plan = msgspec.structs.replace(profile.conditions[0], **rule)
    opened = open_rows(tmp_path / "store")
    with Store(tmp_path / "store") as store:
        checks = [
            one.check
            for one in row_checks.stored(
                store, opened.rows, profile, [*profile.conditions, on_the_plan]
            )
        ]
    assert "labels: wheel_slip" in checks
    assert not {"labels: blocked_aisle", "labels: on_the_plan"} & set(checks)


def test_panel_is_compared_with_its_store(tmp_path: Path) -> None:
    """Report changes made after mixing: the critic is fed them, and the store lacks them."""
    profile = load_profile("warehouse_amr")
    ingest(ROOT / "sample_logs/amr_tuesday", profile, store=StoreWriter(tmp_path / "store"))
    panel = panel_of(tmp_path / "store", EVERY + NO_SPLIT, tmp_path / "panel")
    compared = [row for row in run_checks(open_rows(panel.path)) if row.check.startswith("fed ")]
    assert len(compared) > 1
    assert {(row.status, row.logs) for row in compared} == {("ok", 0.0)}

    meta = panel.meta
    _rewrite_panel(panel, condition=["blocked_aisle"] * len(meta))
    opened = open_rows(panel.path)
    assert (np.diff(opened.rows.logged_ns)[opened.rows.joined[1:]] > 0).all()
    found = diagnose_rows(opened.rows, None, "there is none", more=opened.checks).findings
    (finding,) = [one for one in found if one.cause.startswith("LABELS_")]
    assert finding.cause == "LABELS_CHANGED"
    assert "nominal 100%" in finding.text

    _rewrite_panel(panel, action=[99, *meta["action"].to_pylist()[1:]])
    with pytest.raises(PanelError, match=r"has action 99, and the task has actions 0 to \d"):
        open_rows(panel.path)


def _rewrite_panel(panel: Panel, **columns: list[Any]) -> None:
    """Replace columns of `meta` and seal the panel again, as other software could."""
    path, header = panel.path / META, panel.path / HEADER
    meta = replaced(panel.meta, columns)
    path.unlink()
    pq.write_table(meta, path)
    files = panel.header.files | {META: FileRecord.of(path)}
    header.unlink()
    header.write_bytes(seal(msgspec.structs.replace(panel.header, files=files)))


@pytest.mark.parametrize(
    ("of_run", "together"),
    [("HEALTHY", "BUFFER"), ("TARGET", "BOTH"), ("DIVERGENCE", "DIVERGENCE")],
)
def test_run_verdict_includes_its_rows(logs, twin, of_run, together):
    alone = Diagnosis(of_run, [of_run], [], [], ["a figure"], "none needed")
    assert with_rows(alone, diagnose_rows(logs, twin)) == alone
    both = with_rows(alone, diagnose_rows(_mirror_turns(logs), twin))
    assert (both.cause, both.runs) == (together, [of_run])
    assert both.evidence[-1] == "rows: ACTIONS_MIRRORED: the logs' left is the twin's right"
    why = f"{of_run} by the run's own figures, {together} with the rows that were fed:"
    assert (why in both.evidence) is (of_run != together)
