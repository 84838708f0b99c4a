"""A task's own SQL for reward and observation: on logs, in the twin, and rejected SQL."""

import re
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from support.paths import ROOT
from support.profile_texts import WAREHOUSE

from restock.cli import main
from restock.errors import ConfigError
from restock.ingest.profile.profile import load_profile, parse_profile, profile_toml
from restock.ingest.task.schema import steps_schema
from restock.ingest.task.task import STORED_SIGNALS, Mirror, Task
from restock.ingest.task.task_sql import observed_in_log, own_reward
from restock.replay.store.store import Store
from restock.train.twin.env.vector_env import WarehouseVectorEnv

TERMS = """
[task.reward_terms]
close = [-0.5, "clearance_m < 2 * tight_clearance_m AND wheel_speed_mps > 0.4"]
swerve = [-0.2, "abs(gyro_yaw_rate_radps - lag(gyro_yaw_rate_radps, {0.4 s}) OVER episode)"]
"""
ENTRIES = """
[task.observed]
nearing = "lag(clearance_m) OVER episode - clearance_m"
busy = "avg(abs(gyro_yaw_rate_radps)) OVER (episode ROWS BETWEEN {0.6 s} PRECEDING AND CURRENT ROW)"
goal_m = "least(goal_distance_m, 5)"
"""
BATTERY = """
[task.reward_terms]
low = [-1.0, "battery_v < 26.39"]

[signals.battery_v]
topic = "/diagnostics"
type = "diagnostic_msgs/msg/DiagnosticArray"
path = "status[name=battery].values[key=voltage].value"
unit = "V"
"""


def open_ingested(folder: Path, more: str) -> Store:
    """Ingest a shipped recording with the shipped profile plus `more`, and open the store."""
    (folder / "own.toml").write_text(WAREHOUSE + more)
    tuesday, profile = ROOT / "sample_logs" / "amr_tuesday", folder / "own.toml"
    to = ["--profile", str(profile), "--store", str(folder / "store")]
    assert main(["ingest", str(tuesday), *to]) == 0
    return Store(folder / "store")


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> pa.Table:
    with open_ingested(tmp_path_factory.mktemp("plain"), "") as store:
        return store.sql("FROM transitions ORDER BY transition_id").to_arrow_table()


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory) -> pa.Table:
    with open_ingested(tmp_path_factory.mktemp("own"), TERMS + ENTRIES) as store:
        return store.sql("FROM transitions ORDER BY transition_id").to_arrow_table()


def test_reward_terms_use_the_next_step(plain, rows):
    differ = {name for name in rows.column_names if not rows[name].equals(plain[name])}
    assert differ - {"ingest_id", "source_file"} == {
        *("reward", "task_hash", "profile_hash"),
        *("observation", "next_observation"),  # own entries are appended
    }
    added = rows["reward"].to_numpy() - plain["reward"].to_numpy()
    step, speed, near, turn = (
        rows[name].to_numpy()
        for name in ("step_index", "wheel_speed_mps", "clearance_m", "gyro_yaw_rate_radps")
    )
    inside = np.flatnonzero(step[1:] == step[:-1] + 1)  # the next step is a row, too
    expected = -0.5 * ((near < 0.3) & (speed > 0.4))[inside + 1]
    swerve = 0.2 * np.abs(turn[inside + 1] - turn[inside - 1])
    # two steps back is before the start of the episode
    expected -= np.where(step[inside] > 0, swerve, 0.0)
    np.testing.assert_allclose(added[inside], expected, atol=1e-6)
    assert len(np.unique(expected.round(1))) > 3


def test_own_entries_are_appended_to_observation(plain, rows):
    observed, following, shipped = (
        np.stack(table[name].to_numpy())
        for table, name in (
            (rows, "observation"),
            (rows, "next_observation"),
            (plain, "observation"),
        )
    )
    np.testing.assert_array_equal(observed[:, :-3], shipped)
    step, near, turn, goal = (
        rows[name].to_numpy()
        for name in ("step_index", "clearance_m", "gyro_yaw_rate_radps", "goal_distance_m")
    )
    inside = np.flatnonzero(step >= 3)
    turns = np.mean([np.abs(turn[inside - back]) for back in range(4)], axis=0)
    expected = np.stack([near[inside - 1] - near[inside], turns, np.minimum(goal[inside], 5)], -1)
    np.testing.assert_allclose(observed[inside, -3:], expected, atol=1e-6)
    inside = np.flatnonzero(step[1:] == step[:-1] + 1)
    np.testing.assert_array_equal(observed[inside + 1], following[inside])
    # The last observation of an episode has the goal of that episode, too.
    ends = np.flatnonzero(rows["terminated"].to_numpy() & ~rows["bumped"].to_numpy())
    assert (following[ends, -1] <= load_profile("warehouse_amr").task.goal_radius_m).any()


def test_reward_term_on_custom_signal_works_only_on_logs(plain, tmp_path):
    with open_ingested(tmp_path, BATTERY) as store:
        rows = store.sql("FROM transitions ORDER BY transition_id").to_arrow_table()
    added = (rows["reward"].to_numpy() - plain["reward"].to_numpy()).round(5)
    assert set(added.tolist()) == {0.0, -1.0}
    task = load_profile(tmp_path / "own.toml").task
    with pytest.raises(ConfigError, match=r"reward_terms.low.*battery_v.*the twin does not fill"):
        WarehouseVectorEnv(1, task=task)


def drive_twin(task: Task, steps: int, state: dict | None = None):
    """Return rewards (steps, 2), observations, signals before and after each, and a state."""
    env, rng = WarehouseVectorEnv(2, task=task, seed=3), np.random.default_rng(0)
    on_the_spot = [place for place, (speed, _) in enumerate(task.actions) if not speed]
    actions = rng.choice(on_the_spot, (steps, 2))
    observations, signals, rewards, middle = [env.reset(seed=3)[0]], [env.signals], [], {}
    if state is not None:
        env.load_state_dict(state)
        actions = actions[steps // 2 :]
    for index, action in enumerate(actions):
        if index == steps // 2:
            middle = env.state_dict()
        observation, reward, terminated, truncated, info = env.step(action)
        assert not (terminated | truncated).any()
        rewards.append(reward)
        observations.append(observation)
        signals.append(info["signals"])
    return np.array(rewards), np.array(observations), signals, middle


def test_twin_matches_ingest_and_resumes_exactly():
    own = parse_profile(WAREHOUSE + TERMS + ENTRIES, where="own.toml").task
    rewards, observations, signals, middle = drive_twin(own, 24)
    plain_rewards, plain_observations, _, _ = drive_twin(load_profile("warehouse_amr").task, 24)
    np.testing.assert_array_equal(observations[..., :-3], plain_observations)
    for robot in range(2):
        keys = {"episode_index": np.zeros(25, np.int64), "step_index": np.arange(25)}
        now = {
            s.name: np.array([step_signals[s.name][robot] for step_signals in signals])
            for s in STORED_SIGNALS
        }
        logged = pa.table(keys | now).cast(steps_schema())
        expected = own_reward(own, logged)[1:]
        np.testing.assert_array_equal(rewards[:, robot], plain_rewards[:, robot] + expected)
        assert np.count_nonzero(expected) > 12
        entries = observed_in_log(own, now, np.arange(25) > 0)
        np.testing.assert_array_equal(observations[:, robot, -3:], entries)
        assert np.count_nonzero(entries) > 50
        # Neither depends on later steps.
        np.testing.assert_array_equal(own_reward(own, logged[:9])[1:], expected[:8])
        early = {name: column[:9] for name, column in now.items()}
        np.testing.assert_array_equal(observed_in_log(own, early, np.arange(9) > 0), entries[:9])
    resumed = drive_twin(own, 24, middle)
    np.testing.assert_array_equal(resumed[0], rewards[12:])
    np.testing.assert_array_equal(resumed[1][1:], observations[13:])


def test_own_sql_changes_task_hash():
    plain = load_profile("warehouse_amr")
    own = parse_profile(WAREHOUSE + TERMS + ENTRIES, where="own.toml")
    assert not re.search("reward_terms|observed", profile_toml(plain))
    assert own.task.observation_names[:-3] == plain.task.observation_names
    assert own.task.observation_size == len(own.task.observation_names)
    assert parse_profile(profile_toml(own), where="carried") == own
    other = WAREHOUSE + TERMS.replace("-0.5", "-0.6") + ENTRIES
    hashes = {plain.task.hash, own.task.hash, parse_profile(other, where="other.toml").task.hash}
    assert len(hashes) == 3


INVALID_SQL = [
    ("reward_terms", 'x = [1, "lead(clearance_m) OVER episode"]', "may look at later steps"),
    ("reward_terms", 'x = [1, "clearence_m < 1"]', 'Referenced column "clearence_m" not found'),
    ("reward_terms", "x = [1, \"'much'\"]", "its SQL gives VARCHAR, not a number"),
    ("reward_terms", 'x = [1, "command_speed_mps"]', "which is chosen only after the step"),
    ("reward_terms", 'x = [1, "(SELECT 1)"]', "it contains a query"),
    ("reward_terms", 'goal = [1, "true"]', "'goal' is one of Restock's: choose another name"),
    ("reward_terms", '"a b" = [1, "true"]', "a name is letters, digits and _"),
    ("reward_terms", "x = [nan, 'true']", "must be finite"),
    ("reward_terms", "x = 'bumped'", '`task.reward_terms.x` must be [WEIGHT, "SQL"]'),
    ("observed", 'x = "lead(clearance_m) OVER episode"', "lead() may look at later steps"),
    ("observed", 'x = "max(clearance_m) OVER episode"', "its SQL looks back without limit"),
    ("observed", 'x = "step_index"', "which a running robot does not number"),
    ("observed", 'x = "command_speed_mps"', "which is chosen only after the step"),
    ("observed", 'x = "battery_v"', "uses battery_v, which a running robot does not fill"),
    ("observed", 'wheel_speed = "1"', "'wheel_speed' is one of Restock's"),
]


@pytest.mark.parametrize(("table", "line", "message"), INVALID_SQL)
def test_invalid_task_sql_is_rejected_with_its_key(table, line, message):
    with pytest.raises(ConfigError) as error:
        parse_profile(f"{WAREHOUSE}\n[task.{table}]\n{line}\n", where="own.toml")
    assert message in str(error.value)
    assert table in str(error.value)


def test_own_entries_cannot_be_mirrored():
    own = parse_profile(WAREHOUSE + ENTRIES, where="own.toml").task
    with pytest.raises(ValueError, match="mirror image"):
        Mirror.of(own)


def remove_inputs(text: str, *inputs: str) -> str:
    return re.sub(rf"(?ms)^\[inputs\.({'|'.join(inputs)})\].*?(?=^\[)", "", text)


HINDSIGHT = WAREHOUSE.replace("[clock]", '[goal]\nsource = "hindsight"\n\n[clock]', 1)


@pytest.mark.parametrize(
    ("text", "sql", "message"),
    [
        (remove_inputs(WAREHOUSE, "scan"), "coalesce(clearance_m, 9)", "there is no lidar"),
        (remove_inputs(HINDSIGHT, "goal", "plan"), "plan_gap_m", "the path that was driven"),
    ],
)
def test_reward_term_on_unknown_signal_is_rejected(text, sql, message):
    with pytest.raises(ConfigError, match=message):
        parse_profile(f'{text}\n[task.reward_terms]\nx = [1, "{sql}"]\n', where="own.toml")


def test_unbounded_reward_term_is_rejected():
    task = parse_profile(f'{WAREHOUSE}\n[task.reward_terms]\nx = [1, "exp(710)"]\n', where="").task
    steps = pa.table({name: [0] for name in ("episode_index", "step_index")})
    with pytest.raises(ConfigError, match="it is inf at a step"):
        own_reward(task, steps)
