"""Conditions and exposures: what they say of a step, how surely, and what is refused."""

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
    labels_version,
    let_values,
    primary,
    probabilities,
    settings_of,
    shipped,
    uncertain_steps,
)
from restock.ingest.task.schema import SIGNAL_COLUMNS
from restock.ingest.task.task import STAND_IN_LIMITS, Noise
from restock.replay.store.store import Store

SHIPPED = list(shipped().values())


def steps(count: int, **signals: object) -> pa.Table:
    """Return an episode of a robot at .5 m/s with nothing near, but for these signals."""
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


def changed(value: float, usual: float, count: int, at: slice) -> np.ndarray:
    """Return a column (N,) of one value, and of another at some steps."""
    column = np.full(count, usual)
    column[at] = value
    return column


def given_to(table: pa.Table, name: str, constants: dict[str, float] | None = None) -> list[int]:
    """Return the rows that a shipped condition or exposure holds at, by constants of a robot."""
    made = (shipped(constants) | shipped(constants, "exposure"))[name]
    return np.flatnonzero(label(table, [made])[name]).tolist()


def test_nothing_is_labelled_where_nothing_happens():
    labels = label(steps(20), SHIPPED)
    assert set(labels) == {"recovery", "near_collision", "wheel_slip", "blocked_aisle"}
    assert not any(given.any() for given in labels.values())
    assert primary(labels, SHIPPED) == ["nominal"] * 20


def test_wheels_that_turn_faster_than_the_robot_goes_slip():
    table = steps(20, wheel_speed_mps=changed(1.2, 0.5, 20, slice(8, 12)))
    found = given_to(table, "wheel_slip")
    assert set(range(8, 12)) <= set(found) <= set(range(7, 13))


def test_a_spin_that_the_gyroscope_does_not_feel_is_slip():
    table = steps(20, wheel_yaw_rate_radps=changed(1.0, 0.0, 20, slice(8, 12)))
    assert {8, 9, 10} <= set(given_to(table, "wheel_slip")) <= set(range(7, 13))


def test_a_bump_makes_the_step_before_it_a_near_collision():
    bumped = np.zeros(20, np.bool_)
    bumped[9] = True
    assert given_to(steps(20, bumped=bumped), "near_collision") == [8]


def in_the_way(drive: dict[str, np.ndarray], ahead: np.ndarray, aside_m: float = 0.0) -> pa.Table:
    """Return steps of a robot that sees something this far ahead, and what came nearer."""
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
def test_only_an_obstacle_that_stays_blocks_an_aisle(planned):
    speed = np.where(np.arange(60) < 20, 0.9, 0.0)  # up to a pallet, and stop before it
    x = np.concatenate([[0.0], np.cumsum(speed * 0.2)[:-1]])
    drive = {
        "pose_x_m": x,
        "wheel_speed_mps": speed,
        "route_remaining_m": 9.0 - x if planned else np.zeros(60),
    }
    passing = in_the_way(drive, changed(0.8, 4.0, 60, slice(8, 9)))
    assert given_to(passing, "blocked_aisle") == []
    found = given_to(in_the_way(drive, 4.5 - x), "blocked_aisle")
    assert {22, 30, 50, 59} <= set(found)
    assert found[0] >= 14  # 1.9 m before it
    corner = in_the_way(drive, 4.5 - x, aside_m=0.22)  # of a rack, which the plan passes
    assert given_to(corner, "blocked_aisle") == []
    # Somebody walks up to the robot as fast as it drives, stands there, and is away after a while.
    ahead = np.concatenate([np.linspace(4, 0.6, 10), np.full(15, 0.6), np.full(35, 4.0)])
    assert given_to(in_the_way(drive, ahead), "blocked_aisle") == []


def test_recovery_lasts_until_there_is_room_again():
    table = steps(30, clearance_m=np.array([2.0] * 10 + [0.1] * 3 + [0.2] * 4 + [0.5] * 13))
    found = given_to(table, "recovery")
    assert set(range(11, 16)) <= set(found)
    assert found[0] >= 10
    assert found[-1] <= 17
    assert found == list(range(found[0], found[-1] + 1))


SMALL = {  # of a robot of .2 m/s that is .15 m wide, and decides ten times a second
    "tight_clearance_m": 0.05,
    "body_width_m": 0.15,
    "slip_limit_mps": 0.03,
    "fastest_mps": 0.2,
    "control_period_s": 0.1,
}


def test_the_default_limits_are_those_of_the_stand_in():
    assert load_profile("warehouse_amr").task.condition_limits == STAND_IN_LIMITS


def test_how_near_is_near_follows_the_robot():
    table = steps(30, clearance_m=np.array([2.0] * 10 + [0.1] * 3 + [0.2] * 4 + [0.5] * 13))
    small = Noise().constants | SMALL
    assert given_to(table, "near_collision")
    assert given_to(table, "near_collision", small) == given_to(table, "recovery", small) == []
    nearer = steps(30, clearance_m=np.array([2.0] * 10 + [0.02] * 3 + [0.2] * 17))
    assert {9, 10, 11} <= set(given_to(nearer, "near_collision", small)) <= set(range(8, 13))
    assert given_to(nearer, "recovery", small)[-1] <= 13  # there is room again at .1 m


def test_slip_limit_follows_robot_and_localiser_noise():
    table = steps(60, wheel_speed_mps=changed(0.58, 0.5, 60, slice(20, 40)))
    assert given_to(table, "wheel_slip") == []
    small = Noise().constants | SMALL
    assert set(range(20, 30)) <= set(given_to(table, "wheel_slip", small)) <= set(range(5, 40))
    floor = given_to(table, "slippery_floor", small)
    assert floor[0] >= 20  # not before
    assert set(range(30, 40)) <= set(floor) <= set(range(20, 55))
    noisy = Noise(localiser_m=0.05).constants | SMALL  # two such poses differ by as much
    assert given_to(table, "wheel_slip", noisy) == given_to(table, "slippery_floor", noisy) == []


def test_times_are_in_steps_of_the_robot():
    came = changed(0.3, 0.0, 40, slice(8, 9))
    for period_s, last in ((0.2, 16), (0.1, 26), (0.5, 11), (3.0, 9)):  # .8 s and 1 s, in steps
        task = Noise().constants | SMALL | {"control_period_s": period_s}
        held = given_to(steps(40, came_nearer_m=came), "closing_traffic", task)
        assert held == list(range(8, last + 1))


@pytest.mark.parametrize("period_s", [0.2, 0.1, 0.05])
def test_who_walks_up_is_seen_whatever_the_control_period(period_s: float):
    robot = Noise().constants | STAND_IN_LIMITS | {"control_period_s": period_s}
    begins, ends = round(4 / period_s), round(6 / period_s)
    for walks_mps, seen in ((0.5, True), (0.1, False)):  # .1 m/s: the noise of two ranges
        came = changed(walks_mps * period_s, 0.0, 2 * ends, slice(begins, ends))
        held = given_to(steps(2 * ends, came_nearer_m=came), "closing_traffic", robot)
        if seen:
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
def test_a_pre_condition_does_not_change_when_the_future_does(table, data):
    """Steps after t are exchanged for others: the labels of the steps up to t stay."""
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
def test_episodes_do_not_see_each_other(first, second):
    index = first.column_names.index("episode_index")
    other = second.set_column(index, "episode_index", pa.array(np.ones(len(second), np.int32)))
    both = label(pa.concat_tables([first, other]), SHIPPED)
    alone = label(first, SHIPPED)
    for name, given_ in alone.items():
        assert np.array_equal(both[name][: len(first)], given_), name


def test_labels_are_in_the_order_of_the_rows():
    table = steps(6, bumped=np.array([False, False, True, False, False, False]))
    shuffled = table.take([5, 1, 0, 3, 2, 4])
    found = label(shuffled, [shipped()["near_collision"]])["near_collision"]
    assert np.flatnonzero(found).tolist() == [1]


def test_the_lowest_priority_number_names_the_row():
    low, high = Condition("a", "pre", "true", priority=1), Condition("b", "pre", "true")
    labels = label(steps(2), [high, low])
    assert primary(labels, [high, low]) == ["a", "a"]


def test_a_condition_that_does_not_run_is_named():
    good, bad = Condition("good", "pre", "true"), Condition("bad", "pre", "clearance_mm < 1")
    with pytest.raises(ConfigError) as error:
        label(steps(3), [good, bad])
    assert "condition 'bad'" in str(error.value)
    assert "clearance_m" in str(error.value)


def doubled(times: int) -> dict[str, str]:
    """Return a text that gets twice as long with each name."""
    first = {"text_0": "'x' || clearance_m::VARCHAR"}
    return first | {f"text_{n + 1}": f"text_{n} || text_{n}" for n in range(times)}


def test_a_condition_that_takes_too_long_is_stopped_and_named(monkeypatch):
    monkeypatch.setattr(conditions, "LIMIT_S", 0.1)
    monkeypatch.setattr(conditions, "LIMIT_S_PER_STEP", 0.0)
    sql = "length(regexp_replace(text_11, '[0-9]+', 'y', 'g')) < 0"
    slow = Condition("slow", "pre", sql, let=doubled(11))
    with pytest.raises(
        ConfigError, match=r"condition 'slow': its SQL takes too long.* 5,000 steps"
    ):
        label(steps(5_000), [Condition("good", "pre", "true"), slow])
    monkeypatch.undo()
    assert label(steps(3), [slow])["slow"].tolist() == [False] * 3


@pytest.mark.long
def test_a_condition_that_takes_too_much_memory_is_named():
    large = Condition("large", "pre", "length(text_26) > 1", let=doubled(26))
    with pytest.raises(ConfigError, match=r"condition 'large': its SQL takes more memory .*1GB"):
        label(steps(200), [Condition("good", "pre", "true"), large])


REFUSED = {
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


@pytest.mark.parametrize("sql", REFUSED)
def test_what_a_stranger_might_write_in_a_condition(sql, tmp_path, monkeypatch):
    """No files, no other tables, no settings, no clock, no chance, no look ahead under `pre`."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match="condition 'x'") as error:
        label(steps(3), [Condition("x", "pre", sql)])
    assert REFUSED[sql] in str(error.value)
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
def test_what_a_condition_may_say(sql):
    assert label(steps(3), [Condition("x", "pre", sql)])["x"].any()


@pytest.mark.parametrize("name", ['a" FROM steps; --', "nominal", "", "a b", "1a"])
def test_a_condition_has_a_plain_name(name):
    with pytest.raises(ValueError, match="letters, digits and _"):
        Condition(name, "pre", "true")


def test_null_is_false():
    found = label(steps(3), [Condition("n", "post", "lead(bumped) OVER episode")])["n"]
    assert found.tolist() == [False, False, False]


def test_what_a_rule_goes_by_can_be_looked_at():
    rule = Condition(
        name="fast",
        timing="pre",
        sql="change_mps > limit_mps",
        let={"change_mps": "wheel_speed_mps - lag(wheel_speed_mps) OVER episode"},
        constants={"limit_mps": 0.1},
    )
    table = steps(3, wheel_speed_mps=np.array([0.0, 0.5, 0.25]))
    found = let_values(table, rule)["change_mps"]
    assert np.isnan(found[0])  # null: there is no step before
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


def test_parts_of_a_condition_file():
    fast = condition()
    assert (fast.doc, fast.timing, fast.priority) == ("Fast, for a while.", "pre", 35)
    assert list(fast.let) == ["over_mps", "smooth_mps"]
    assert fast.constants == {"lidar_noise_m": 0.1}  # what it names, and no more
    table = steps(5, wheel_speed_mps=np.array([0.5, 0.7, 0.1, 0.9, 0.9]))
    assert label(table, [fast])["fast"].tolist() == [False, True, False, False, True]
    given = probabilities(table, [fast])["fast"]
    assert np.isnan(given[0])
    np.testing.assert_allclose(given[1:], 1 / (1 + np.exp([-1, 1, 0, -4])), rtol=1e-5)
    near = uncertain_steps({"fast": given}, [fast])["fast"]
    assert near.tolist() == [False, False, True, True, False]


def test_more_noise_makes_a_probability_less_sure():
    table = steps(3, wheel_speed_mps=np.array([0.5, 0.7, 0.9]))
    sure, unsure = (probabilities(table, [condition(noise_m=n)])["fast"][2] for n in (0.05, 0.5))
    assert sure > 0.95 > unsure > 0.5


def test_the_version_of_labels_follows_what_can_change_them():
    plain = Condition("fast", "pre", "wheel_speed_mps > 1")
    assert labels_version([plain]) == labels_version([plain.with_constants(Noise().constants)])
    versions = {
        labels_version([condition(text, noise)])
        for text in (FILE, FILE.replace("0.1 to", "0.3 to"), FILE.replace("0.5 --", "0.6 --"))
        for noise in (0.1, 0.2)
    }
    assert len(versions) == 6


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (FILE.replace("wheel_speed_mps - 0.5", "lead(wheel_speed_mps) OVER episode"), "'over_mps"),
        (FILE.replace("let smooth_mps", "let pose_x_m"), "'pose_x_m' is already used"),
        (FILE.replace("1 / (1 + exp(-smooth_mps / lidar_noise_m))", "1.5"), "in \\[0, 1\\]"),
        (FILE.replace("1 / (1 + exp(-smooth_mps / lidar_noise_m))", "'much'"), "not a number"),
        (FILE.replace("1 / (1 +", "1 / (unheard_of +"), "probability of condition 'fast'"),
        (FILE.replace("1 / (1 +", "1 / ((SELECT 1) +"), "contains a query"),
    ],
)
def test_a_probability_keeps_the_rules_of_a_label(text, said):
    with pytest.raises(ConfigError, match=said):
        probabilities(steps(3), [condition(text)])


def test_noise_of_a_profile_does_not_change_rows():
    usual = parse_profile(WAREHOUSE, where="a")
    noisy = parse_profile(WAREHOUSE + "\n[noise]\nlidar_m = 0.05\n", where="b")
    assert usual.hash == noisy.hash
    assert usual.labels_version != noisy.labels_version
    near = next(one for one in noisy.conditions if one.name == "near_collision")
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


def test_a_condition_of_ones_own_may_name_limits_and_write_times() -> None:
    profile = parse_profile(WAREHOUSE + OWN.format("1 s"), where="here")
    tight = profile.conditions[-1]
    assert "ROWS BETWEEN 5 PRECEDING" in tight.sql
    assert tight.constants == {"tight_clearance_m": 0.15}
    carried = parse_profile(profile_toml(profile), where="its text")
    assert carried.labels_version == profile.labels_version
    with pytest.raises(ConfigError, match=r"(?s)tight.*\{1\.6 s\}"):
        parse_profile(WAREHOUSE + OWN.format("1 min"), where="here")


def test_probabilities_stand_beside_how_often_they_are_true(tmp_path):
    table = recording_transitions(1)
    truth = ["recovery" if row % 3 else "nominal" for row in range(len(table))]
    path = write_store(tmp_path / "store", [replaced(table, {"true_condition": truth})])
    rows = [dict(row).get("recovery") for row in table["probabilities"].to_pylist()]
    want: dict[float, list[bool]] = {}
    for told, true in zip(rows, truth, strict=True):
        if told is not None:
            want.setdefault(min(int(told * 10), 9) / 10, []).append(true == "recovery")
    with Store(path) as store:
        found = store.sql("SELECT from_probability, known, true_share FROM label_reliability")
        for tenth, known, share in found.fetchall():
            held = want.pop(tenth)
            assert (known, share) == (len(held), pytest.approx(np.mean(held)))
    assert not want


LISTED = 'exposures = ["closing_traffic", "plan_blocked", "slippery_floor"]'
assert LISTED in WAREHOUSE
FAR_OUT = """
[[condition]]
name = "far_out"
kind = "exposure"
timing = "pre"
sql = "pose_x_m > 2"
"""


def test_each_situation_is_told_by_what_is_known_before_acting():
    assert given_to(steps(20), "closing_traffic") == []
    someone = steps(20, came_nearer_m=changed(0.1, 0.0, 20, slice(8, 10)))
    assert given_to(someone, "closing_traffic") == [9, 10, 11, *range(12, 17)]
    noise = steps(20, came_nearer_m=np.full(20, 0.03))
    assert given_to(noise, "closing_traffic") == []
    pallet = {"plan_return_m": changed(1.5, 4.0, 20, slice(5, 15))}
    assert given_to(steps(20, **pallet), "plan_blocked") == list(range(9, 15))
    walker = {"came_nearer_m": changed(0.15, 0.0, 20, slice(3, 5))}
    assert given_to(steps(20, **pallet, **walker), "plan_blocked") == []
    ice = steps(20, wheel_speed_mps=changed(1.0, 0.5, 20, slice(10, 12)))
    assert given_to(ice, "slippery_floor") == list(range(11, 17))
    assert given_to(steps(20), "slippery_floor") == []


def test_an_exposure_takes_no_row_from_a_condition():
    first = Condition("busy", "pre", "true", priority=0, kind="exposure")
    every = [*SHIPPED, first]
    table = steps(20, clearance_m=changed(0.05, 2.0, 20, slice(8, 10)))
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


def test_a_store_lists_exposures_beside_its_conditions(store, profile):
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


def test_changed_exposures_are_told_again_from_the_store(store, profile, tmp_path):
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
