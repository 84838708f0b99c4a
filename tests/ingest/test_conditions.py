"""Conditions and exposures: their labels, their probabilities, and rejected definitions."""

import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.driven_robot import Drive, write_bag
from support.ingested import ingested
from support.profile_texts import WAREHOUSE
from support.stores import recording_transitions, write_store

from restock.cli import main
from restock.errors import ConfigError
from restock.ingest.profile.profile import load_profile, parse_profile, profile_toml
from restock.ingest.store.transitions import replaced
from restock.ingest.task import conditions
from restock.ingest.task.conditions import (
    Condition,
    label,
    label_with_probabilities,
    labels_version,
    let_values,
    primary,
    settings_of,
    shipped,
    uncertain_steps,
)
from restock.ingest.task.schema import SIGNAL_COLUMNS
from restock.ingest.task.task import STAND_IN_LIMITS, Noise
from restock.replay.store.store import Store

SHIPPED = list(shipped().values())


def steps(count: int, **signals: object) -> pa.Table:
    """Return an episode of a robot at 0.5 m/s in free space, except for these signals."""
    usual = {
        "stamp_ns": np.arange(count) * 200_000_000,
        "pose_stamp_ns": np.arange(count) * 200_000_000,
        "wheel_speed_mps": np.full(count, 0.5),
        "localised_speed_mps": np.full(count, 0.5),
        "clearance_m": np.full(count, 2.0),
        "clearance_ahead_m": np.full(count, 2.0),
        "plan_return_m": np.full(count, 4.0),
        "plan_gap_m": np.full(count, 4.0),
        "bumped": np.zeros(count, np.bool_),
        "command_speed_mps": np.full(count, 0.5),
        "waypoint_near_x_m": np.ones(count),
        "waypoint_far_x_m": np.full(count, 2.2),
    } | signals
    columns = {
        column.name: pa.array(usual.get(column.name, np.zeros(count))).cast(column.type, safe=False)
        for column in SIGNAL_COLUMNS
    }
    index = np.arange(count)
    return pa.table({"episode_index": np.zeros(count, np.int32), "step_index": index, **columns})


def with_value_at(value: float, usual: float, count: int, at: slice) -> np.ndarray:
    """Return a column (N,) of `usual`, with `value` at some steps."""
    column = np.full(count, usual)
    column[at] = value
    return column


def labelled_rows(
    table: pa.Table, name: str, constants: dict[str, float] | None = None
) -> list[int]:
    """Return the rows that a shipped condition or exposure labels, given constants of a robot."""
    found = (shipped(constants) | shipped(constants, "exposure"))[name]
    return np.flatnonzero(label(table, [found])[name]).tolist()


def test_uneventful_steps_are_nominal():
    labels = label(steps(20), SHIPPED)
    assert set(labels) == {"recovery", "near_collision", "wheel_slip", "blocked_aisle"}
    assert not any(holds.any() for holds in labels.values())
    assert primary(labels, SHIPPED) == ["nominal"] * 20


def test_wheels_faster_than_robot_are_slip():
    table = steps(20, wheel_speed_mps=with_value_at(1.2, 0.5, 20, slice(8, 12)))
    found = labelled_rows(table, "wheel_slip")
    assert set(range(8, 12)) <= set(found) <= set(range(7, 13))


def test_wheel_spin_unseen_by_gyro_is_slip():
    table = steps(20, wheel_yaw_rate_radps=with_value_at(1.0, 0.0, 20, slice(8, 12)))
    assert {8, 9, 10} <= set(labelled_rows(table, "wheel_slip")) <= set(range(7, 13))


def test_step_before_bump_is_near_collision():
    bumped = np.zeros(20, np.bool_)
    bumped[9] = True
    assert labelled_rows(steps(20, bumped=bumped), "near_collision") == [8]


def with_obstacle(
    drive: dict[str, np.ndarray], ahead: np.ndarray, aside_m: float = 0.0
) -> pa.Table:
    """Return steps of a robot that sees an obstacle this far ahead, and how much it came nearer."""
    seen = np.where(ahead < 2.2, ahead, 4.0)
    driven = np.concatenate([[0.0], drive["wheel_speed_mps"][:-1] * 0.2])
    came = np.concatenate([[0.0], ahead[:-1] - ahead[1:]]) - driven
    return steps(
        len(ahead),
        **drive,
        plan_return_m=seen,
        plan_gap_m=np.where(ahead < 1.4, aside_m, 4.0),
        came_nearer_m=np.where(ahead < 2.2, np.clip(came, 0.0, 1.0), 0.0),
        clearance_ahead_m=np.maximum(ahead - 0.35, 0.0),
        clearance_m=np.minimum(ahead, 0.5),
    )


@pytest.mark.parametrize("planned", [True, False])
def test_only_standing_obstacle_blocks_aisle(planned):
    speed = np.where(np.arange(60) < 20, 0.9, 0.0)  # drive up to a pallet and stop before it
    x = np.concatenate([[0.0], np.cumsum(speed * 0.2)[:-1]])
    drive = {
        "pose_x_m": x,
        "wheel_speed_mps": speed,
        "route_remaining_m": 9.0 - x if planned else np.zeros(60),
    }
    passing = with_obstacle(drive, with_value_at(0.8, 4.0, 60, slice(8, 9)))
    assert labelled_rows(passing, "blocked_aisle") == []
    found = labelled_rows(with_obstacle(drive, 4.5 - x), "blocked_aisle")
    assert {22, 30, 50, 59} <= set(found)
    assert found[0] >= 14  # 1.9 m before it
    corner = with_obstacle(drive, 4.5 - x, aside_m=0.22)  # a rack's corner, which the plan passes
    assert labelled_rows(corner, "blocked_aisle") == []
    # A person walks up to the robot as fast as it drives, stands there, and later leaves.
    ahead = np.concatenate([np.linspace(4, 0.6, 10), np.full(15, 0.6), np.full(35, 4.0)])
    assert labelled_rows(with_obstacle(drive, ahead), "blocked_aisle") == []


def test_recovery_lasts_until_clearance_returns():
    table = steps(30, clearance_m=np.array([2.0] * 10 + [0.1] * 3 + [0.2] * 4 + [0.5] * 13))
    found = labelled_rows(table, "recovery")
    assert set(range(11, 16)) <= set(found)
    assert found[0] >= 10
    assert found[-1] <= 17
    assert found == list(range(found[0], found[-1] + 1))


SMALL = {  # a robot of 0.2 m/s, 0.15 m wide, with ten decisions a second
    "tight_clearance_m": 0.05,
    "body_width_m": 0.15,
    "slip_limit_mps": 0.03,
    "fastest_mps": 0.2,
    "control_period_s": 0.1,
}


def test_default_limits_equal_stand_in_limits():
    assert load_profile("warehouse_amr").task.condition_limits == STAND_IN_LIMITS


def test_clearance_limits_follow_robot():
    table = steps(30, clearance_m=np.array([2.0] * 10 + [0.1] * 3 + [0.2] * 4 + [0.5] * 13))
    small = Noise().constants | SMALL
    assert labelled_rows(table, "near_collision")
    assert (
        labelled_rows(table, "near_collision", small)
        == labelled_rows(table, "recovery", small)
        == []
    )
    nearer = steps(30, clearance_m=np.array([2.0] * 10 + [0.02] * 3 + [0.2] * 17))
    assert {9, 10, 11} <= set(labelled_rows(nearer, "near_collision", small)) <= set(range(8, 13))
    assert labelled_rows(nearer, "recovery", small)[-1] <= 13  # 0.1 m is enough room for this robot


def test_slip_limit_follows_robot_and_localiser_noise():
    table = steps(60, wheel_speed_mps=with_value_at(0.58, 0.5, 60, slice(20, 40)))
    assert labelled_rows(table, "wheel_slip") == []
    small = Noise().constants | SMALL
    assert set(range(20, 30)) <= set(labelled_rows(table, "wheel_slip", small)) <= set(range(5, 40))
    floor = labelled_rows(table, "slippery_floor", small)
    assert floor[0] >= 20  # not earlier
    assert set(range(30, 40)) <= set(floor) <= set(range(20, 55))
    # the difference of two such poses has as much noise
    noisy = Noise(localiser_m=0.05).constants | SMALL
    assert (
        labelled_rows(table, "wheel_slip", noisy)
        == labelled_rows(table, "slippery_floor", noisy)
        == []
    )


def test_durations_follow_control_period():
    came = with_value_at(0.3, 0.0, 40, slice(8, 9))
    for period_s, last in ((0.2, 16), (0.1, 26), (0.5, 11), (3.0, 9)):  # 0.8 s and 1 s, in steps
        task = Noise().constants | SMALL | {"control_period_s": period_s}
        held = labelled_rows(steps(40, came_nearer_m=came), "closing_traffic", task)
        assert held == list(range(8, last + 1))


@pytest.mark.parametrize("period_s", [0.2, 0.1, 0.05])
def test_approach_is_detected_at_any_control_period(period_s: float):
    robot = Noise().constants | STAND_IN_LIMITS | {"control_period_s": period_s}
    begins, ends = round(4 / period_s), round(6 / period_s)
    for walks_mps, detected in ((0.5, True), (0.1, False)):  # 0.1 m/s is the noise of two ranges
        came = with_value_at(walks_mps * period_s, 0.0, 2 * ends, slice(begins, ends))
        held = labelled_rows(steps(2 * ends, came_nearer_m=came), "closing_traffic", robot)
        if detected:
            assert begins <= held[0] <= begins + 0.5 / period_s
            assert set(range(held[0], ends)) <= set(held)
        else:
            assert held == []


@st.composite
def tables(draw: st.DrawFn) -> pa.Table:
    count = draw(st.integers(2, 14))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    return steps(
        count,
        wheel_speed_mps=rng.uniform(-1, 2, count),
        localised_speed_mps=rng.uniform(-1, 2, count),
        wheel_yaw_rate_radps=rng.uniform(-1, 1, count),
        gyro_yaw_rate_radps=rng.uniform(-1, 1, count),
        clearance_m=rng.choice([0.05, 0.2, 0.5, 2.0], count),
        clearance_ahead_m=rng.choice([0.3, 0.9, 1.4, 3.0], count),
        plan_return_m=rng.choice([0.4, 0.9, 1.3, 4.0], count),
        plan_gap_m=rng.choice([0.0, 0.1, 0.2, 4.0], count),
        came_nearer_m=rng.choice([0.0, 0.0, 0.02, 0.3], count),
        bumped=rng.random(count) < 0.2,
        goal_distance_m=rng.uniform(0, 9, count),
        route_remaining_m=rng.uniform(0, 9, count),
        pose_x_m=rng.uniform(0, 9, count),
        pose_y_m=rng.uniform(0, 9, count),
        command_speed_mps=rng.uniform(-1, 1, count),
    )


@settings(max_examples=15)
@given(tables(), st.data())
def test_pre_condition_ignores_later_steps(table, data):
    """Replacing the steps after t keeps the labels up to t."""
    until = data.draw(st.integers(0, len(table) - 1))
    other = data.draw(tables())
    future = other.slice(0, max(len(other) - 1, 1))
    shift = pa.array(np.arange(len(future), dtype=np.int64) + until + 1)
    future = future.set_column(
        future.column_names.index("step_index"), "step_index", shift
    ).set_column(
        future.column_names.index("stamp_ns"),
        "stamp_ns",
        pa.array((np.arange(len(future)) + until + 1) * 200_000_000),
    )
    altered = pa.concat_tables([table.slice(0, until + 1), future], promote_options="default")
    every = [*SHIPPED, *shipped(kind="exposure").values()]
    pre = [condition for condition in every if condition.timing == "pre"]
    before, after = label(table, pre), label(altered, pre)
    for name, holds in before.items():
        assert np.array_equal(holds[: until + 1], after[name][: until + 1]), name


@settings(max_examples=10)
@given(tables(), tables())
def test_episodes_are_labelled_independently(first, second):
    index = first.column_names.index("episode_index")
    other = second.set_column(index, "episode_index", pa.array(np.ones(len(second), np.int32)))
    both = label(pa.concat_tables([first, other]), SHIPPED)
    alone = label(first, SHIPPED)
    for name, holds in alone.items():
        assert np.array_equal(both[name][: len(first)], holds), name


def test_labels_keep_row_order():
    table = steps(6, bumped=np.array([False, False, True, False, False, False]))
    shuffled = table.take([5, 1, 0, 3, 2, 4])
    found = label(shuffled, [shipped()["near_collision"]])["near_collision"]
    assert np.flatnonzero(found).tolist() == [1]


def test_lowest_priority_number_is_primary_condition():
    low, high = Condition("a", "pre", "true", priority=1), Condition("b", "pre", "true")
    labels = label(steps(2), [high, low])
    assert primary(labels, [high, low]) == ["a", "a"]


def test_failing_condition_is_reported_by_name():
    good, bad = Condition("good", "pre", "true"), Condition("bad", "pre", "clearance_mm < 1")
    with pytest.raises(ConfigError) as error:
        label(steps(3), [good, bad])
    assert "condition 'bad'" in str(error.value)
    assert "clearance_m" in str(error.value)


def doubling_let(times: int) -> dict[str, str]:
    """Return `let` entries whose text doubles in length with each name."""
    first = {"text_0": "'x' || clearance_m::VARCHAR"}
    return first | {f"text_{n + 1}": f"text_{n} || text_{n}" for n in range(times)}


def test_slow_condition_is_stopped_and_reported(monkeypatch):
    monkeypatch.setattr(conditions, "LIMIT_S", 0.1)
    monkeypatch.setattr(conditions, "LIMIT_S_PER_STEP", 0.0)
    sql = "length(regexp_replace(text_11, '[0-9]+', 'y', 'g')) < 0"
    slow = Condition("slow", "pre", sql, let=doubling_let(11))
    with pytest.raises(
        ConfigError, match=r"condition 'slow': its SQL takes too long.* 5,000 steps"
    ):
        label(steps(5_000), [Condition("good", "pre", "true"), slow])
    monkeypatch.undo()
    assert label(steps(3), [slow])["slow"].tolist() == [False] * 3


@pytest.mark.long
def test_memory_hungry_condition_is_reported():
    large = Condition("large", "pre", "length(text_26) > 1", let=doubling_let(26))
    with pytest.raises(ConfigError, match=r"condition 'large': its SQL takes more memory .*1GB"):
        label(steps(200), [Condition("good", "pre", "true"), large])


REJECTED_SQL = {
    "(SELECT count(*) FROM read_text('/etc/passwd')) > 0": "it contains a query",
    "read_text('/etc/passwd') IS NULL": "fails on the steps",
    "user = 'x'": "reads data other than the steps",
    "random() < 0.5": "reads data other than the steps",
    "sleep_ms(100000) IS NULL": "reads data other than the steps",
    "length(repeat('x', 4000000000)) > 1": "can use unlimited memory",
    "unnest([true, false, true])": "makes several rows of one",
    "ATTACH 'x.db'": "fails on the steps",
    "COPY steps TO 'x.csv'": "syntax error",
    "true); ATTACH 'x.db'; SELECT (true": "SELECT",
    "true) AS x, (SELECT 1": "more than one expression",
    "true) FROM steps WHERE (true": "syntax error",
    "false) OR (true": "its brackets do not match",
    "clearance_m > 1) -- (": "syntax error",
    "true /*": "comment",
    "COLUMNS(*) > 1": "it contains *",
    "$1": "it contains a parameter",
    "max(clearance_m) OVER () > 1": "would see other episodes",
    "lag(clearance_m) > 1": "write `lag(x) OVER episode`",
    "lead(bumped) OVER episode": 'set timing = "post"',
    "max(bumped) OVER (episode ROWS BETWEEN 1 PRECEDING AND 1 FOLLOWING)": "at CURRENT ROW",
    "lag(bumped, -1) OVER episode": "give lag() a constant number",
    "max(bumped) OVER (PARTITION BY episode_index ORDER BY step_index DESC)": "write OVER episode",
    "percent_rank() OVER episode > 0.5": 'set timing = "post"',
}


@pytest.mark.parametrize("sql", REJECTED_SQL)
def test_unsafe_condition_sql_is_rejected(sql, tmp_path, monkeypatch):
    """Conditions read no files, tables, settings, clock or randomness; `pre` never looks ahead."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match="condition 'x'") as error:
        label(steps(3), [Condition("x", "pre", sql)])
    assert REJECTED_SQL[sql] in str(error.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "sql",
    [
        "count(*) OVER episode > 2",
        "lag(clearance_m, 2) OVER episode > 1 AND list_max([clearance_m, 1.5]) > 1",
        "avg(clearance_m) FILTER (NOT bumped) OVER (episode ROWS 5 PRECEDING) > 1",
        "rank() OVER episode = 1 OR clearance_m BETWEEN 1 AND 2 OR nullif(clearance_m, 2) IS NULL",
        "'](' <> ')[' AND clearance_m > 1 -- ((",
        "list_filter([clearance_m], lambda x: x > 1)[1] > 1",
    ],
)
def test_valid_condition_sql_is_accepted(sql):
    assert label(steps(3), [Condition("x", "pre", sql)])["x"].any()


@pytest.mark.parametrize("name", ['a" FROM steps; --', "nominal", "", "a b", "1a"])
def test_invalid_condition_name_is_rejected(name):
    with pytest.raises(ValueError, match="letters, digits and _"):
        Condition(name, "pre", "true")


def test_null_label_is_false():
    found = label(steps(3), [Condition("n", "post", "lead(bumped) OVER episode")])["n"]
    assert found.tolist() == [False, False, False]


def test_let_values_of_condition():
    rule = Condition(
        name="fast",
        timing="pre",
        sql="change_mps > limit_mps",
        let={"change_mps": "wheel_speed_mps - lag(wheel_speed_mps) OVER episode"},
        constants={"limit_mps": 0.1},
    )
    table = steps(3, wheel_speed_mps=np.array([0.0, 0.5, 0.25]))
    found = let_values(table, rule)["change_mps"]
    assert np.isnan(found[0])  # null: the first step has no previous one
    assert found[1:].tolist() == [0.5, -0.25]
    with pytest.raises(ConfigError, match=r"VARCHAR|string"):
        let_values(table, Condition(name="text", timing="pre", sql="true", let={"word": "'a'"}))


FILE = """-- Fast, for a while.
-- timing: pre
-- priority: 35
-- uncertain: 0.1 to 0.6
-- let over_mps:
wheel_speed_mps - 0.5 -- of half a metre a second
-- let smooth_mps:
avg(over_mps) OVER (episode ROWS BETWEEN 1 PRECEDING AND CURRENT ROW)
-- label:
smooth_mps > 0
-- probability:
CASE WHEN step_index > 0 THEN 1 / (1 + exp(-smooth_mps / lidar_noise_m)) END
"""


def condition(text: str = FILE, noise_m: float = 0.1) -> Condition:
    made = Condition(name="fast", **settings_of(text))
    return made.with_constants(Noise(lidar_m=noise_m).constants)


def test_condition_file_parts():
    fast = condition()
    assert (fast.doc, fast.timing, fast.priority) == ("Fast, for a while.", "pre", 35)
    assert list(fast.let) == ["over_mps", "smooth_mps"]
    assert fast.constants == {"lidar_noise_m": 0.1}  # only the constants that it uses
    table = steps(5, wheel_speed_mps=np.array([0.5, 0.7, 0.1, 0.9, 0.9]))
    labels, probable = label_with_probabilities(table, [fast])
    assert labels["fast"].tolist() == [False, True, False, False, True]
    probability = probable["fast"]
    assert np.isnan(probability[0])
    np.testing.assert_allclose(probability[1:], 1 / (1 + np.exp([-1, 1, 0, -4])), rtol=1e-5)
    uncertain = uncertain_steps({"fast": probability}, [fast])["fast"]
    assert uncertain.tolist() == [False, False, True, True, False]


def test_more_noise_makes_probability_less_certain():
    table = steps(3, wheel_speed_mps=np.array([0.5, 0.7, 0.9]))
    certain, uncertain = (
        label_with_probabilities(table, [condition(noise_m=n)])[1]["fast"][2] for n in (0.05, 0.5)
    )
    assert certain > 0.95 > uncertain > 0.5


def test_labels_version_follows_rule_and_constants():
    plain = Condition("fast", "pre", "wheel_speed_mps > 1")
    assert labels_version([plain]) == labels_version([plain.with_constants(Noise().constants)])
    versions = {
        labels_version([condition(text, noise)])
        for text in (FILE, FILE.replace("0.1 to", "0.3 to"), FILE.replace("0.5 --", "0.6 --"))
        for noise in (0.1, 0.2)
    }
    assert len(versions) == 6


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (FILE.replace("wheel_speed_mps - 0.5", "lead(wheel_speed_mps) OVER episode"), "'over_mps"),
        (FILE.replace("let smooth_mps", "let pose_x_m"), "'pose_x_m' is already used"),
        (FILE.replace("1 / (1 + exp(-smooth_mps / lidar_noise_m))", "1.5"), "in \\[0, 1\\]"),
        (FILE.replace("1 / (1 + exp(-smooth_mps / lidar_noise_m))", "'much'"), "not a number"),
        (FILE.replace("1 / (1 +", "1 / (unheard_of +"), "probability of condition 'fast'"),
        (FILE.replace("1 / (1 +", "1 / ((SELECT 1) +"), "contains a query"),
    ],
)
def test_invalid_probability_sql_is_rejected(text, message):
    with pytest.raises(ConfigError, match=message):
        label_with_probabilities(steps(3), [condition(text)])


def test_noise_changes_labels_version_but_not_hash():
    usual = parse_profile(WAREHOUSE, where="a")
    noisy = parse_profile(WAREHOUSE + "\n[noise]\nlidar_m = 0.05\n", where="b")
    assert usual.hash == noisy.hash
    assert usual.labels_version != noisy.labels_version
    near = next(rule for rule in noisy.conditions if rule.name == "near_collision")
    assert near.constants == {"lidar_noise_m": 0.05, "tight_clearance_m": 0.15}
    carried = parse_profile(profile_toml(noisy), where="its text")
    assert carried.labels_version == noisy.labels_version
    assert shipped(noisy.constants)["near_collision"] == near
    with pytest.raises(ConfigError, match="lidar_m"):
        parse_profile(WAREHOUSE + "\n[noise]\nlidar_m = 0\n", where="c")


OWN = '''
[[condition]]
name = "tight"
timing = "pre"
sql = """
min(clearance_m) OVER (episode ROWS BETWEEN {{{0}}} PRECEDING AND CURRENT ROW)
< tight_clearance_m"""
'''


def test_own_condition_uses_limits_and_durations() -> None:
    profile = parse_profile(WAREHOUSE + OWN.format("1 s"), where="here")
    tight = profile.conditions[-1]
    assert "ROWS BETWEEN 5 PRECEDING" in tight.sql
    assert tight.constants == {"tight_clearance_m": 0.15}
    carried = parse_profile(profile_toml(profile), where="its text")
    assert carried.labels_version == profile.labels_version
    with pytest.raises(ConfigError, match=r"(?s)tight.*\{1\.6 s\}"):
        parse_profile(WAREHOUSE + OWN.format("1 min"), where="here")


def test_label_reliability_compares_with_truth(tmp_path):
    table = recording_transitions(1)
    truth = ["recovery" if row % 3 else "nominal" for row in range(len(table))]
    path = write_store(tmp_path / "store", [replaced(table, {"true_condition": truth})])
    rows = [dict(row).get("recovery") for row in table["probabilities"].to_pylist()]
    expected: dict[float, list[bool]] = {}
    for probability, actual in zip(rows, truth, strict=True):
        if probability is not None:
            expected.setdefault(min(int(probability * 10), 9) / 10, []).append(actual == "recovery")
    with Store(path) as store:
        found = store.sql("SELECT from_probability, known, true_share FROM label_reliability")
        for tenth, known, share in found.fetchall():
            held = expected.pop(tenth)
            assert (known, share) == (len(held), pytest.approx(np.mean(held)))
    assert not expected


LISTED = 'exposures = ["closing_traffic", "plan_blocked", "slippery_floor"]'
assert LISTED in WAREHOUSE
FAR_OUT = """
[[condition]]
name = "far_out"
kind = "exposure"
timing = "pre"
sql = "pose_x_m > 2"
"""


def test_shipped_exposures_of_typical_steps():
    assert labelled_rows(steps(20), "closing_traffic") == []
    person = steps(20, came_nearer_m=with_value_at(0.1, 0.0, 20, slice(8, 10)))
    assert labelled_rows(person, "closing_traffic") == [9, 10, 11, *range(12, 17)]
    noise = steps(20, came_nearer_m=np.full(20, 0.03))
    assert labelled_rows(noise, "closing_traffic") == []
    pallet = {"plan_return_m": with_value_at(1.5, 4.0, 20, slice(5, 15))}
    assert labelled_rows(steps(20, **pallet), "plan_blocked") == list(range(9, 15))
    walker = {"came_nearer_m": with_value_at(0.15, 0.0, 20, slice(3, 5))}
    assert labelled_rows(steps(20, **pallet, **walker), "plan_blocked") == []
    ice = steps(20, wheel_speed_mps=with_value_at(1.0, 0.5, 20, slice(10, 12)))
    assert labelled_rows(ice, "slippery_floor") == list(range(11, 17))
    assert labelled_rows(steps(20), "slippery_floor") == []


def test_exposure_is_never_primary_condition():
    first = Condition("busy", "pre", "true", priority=0, kind="exposure")
    every = [*SHIPPED, first]
    table = steps(20, clearance_m=with_value_at(0.05, 2.0, 20, slice(8, 10)))
    labels = label(table, every)
    assert labels["busy"].all()
    named = primary(labels, every)
    assert named == primary({name: labels[name] for name in labels if name != "busy"}, SHIPPED)
    assert {"nominal", "near_collision"} <= set(named)
    assert labels_version(every) != labels_version(SHIPPED)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a store of one drive, beside the profile `amr.toml` of its rows."""
    folder = tmp_path_factory.mktemp("exposures")
    bag, profile = write_bag(Drive(goals=[(0.0, 3.0, 1.0)]), folder / "a"), folder / "amr.toml"
    profile.write_text(WAREHOUSE.replace(LISTED, 'exposures = ["closing_traffic"]') + FAR_OUT)
    ingested(bag, profile, folder / "store").close()
    return folder / "store"


@pytest.fixture
def profile(store: Path) -> Path:
    return store.parent / "amr.toml"


def test_store_lists_exposures_apart_from_conditions(store, profile):
    with Store(store) as opened:
        assert [one.name for one in opened.exposures()] == ["closing_traffic", "far_out"]
        assert "far_out" not in {one.name for one in opened.conditions()}
        held = opened.sql(
            "SELECT DISTINCT pose_x_m > 2, exposures, primary_condition FROM transitions"
            " ORDER BY ALL"
        ).fetchall()
        assert held == [(False, [], "nominal"), (True, ["far_out"], "nominal")]
        rows = {row[0]: row[1:] for row in opened.sql(
            "SELECT exposure, rows, episodes, episode_share, success_share"
                " FROM coverage_by_exposure"
        ).fetchall()}  # fmt: skip
        (count,) = opened.sql("SELECT count(*) FROM transitions WHERE pose_x_m > 2").fetchall()[0]
        assert rows == {"closing_traffic": (0, 0, 0.0, None), "far_out": (count, 1, 1.0, 1.0)}
        shelves = opened.sql("SELECT condition FROM coverage_by_condition").fetchall()
        assert not {"far_out", "closing_traffic"} & {name for (name,) in shelves}
        carried = opened.sql("SELECT profile_toml FROM recordings").fetchall()[0][0]
    assert parse_profile(carried, where="").exposures == load_profile(profile).exposures
    again = parse_profile(profile_toml(load_profile(profile)), where="")
    assert again.labels_version == load_profile(profile).labels_version


def test_relabelling_applies_changed_exposures(store, profile, tmp_path):
    store, text = shutil.copytree(store, tmp_path / "store"), profile.read_text()
    profile = tmp_path / "amr.toml"
    profile.write_text(text.replace("pose_x_m > 2", "pose_x_m > 2.2"))
    assert main(["store", "label", str(store), "--profile", str(profile)]) == 0
    with Store(store) as opened:
        assert opened.sql(
            "SELECT min(pose_x_m) > 2.2, any_value(primary_condition) FROM transitions"
            " WHERE len(exposures) > 0"
        ).fetchall() == [(True, "nominal")]
        assert "2.2" in opened.exposures()[-1].sql
