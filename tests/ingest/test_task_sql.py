"""Reward terms of a task's own, in SQL: on logs, in the twin, and what is refused."""

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
from restock.ingest.task.task import STORED_SIGNALS, Task
from restock.ingest.task.task_sql import own_reward
from restock.replay.store.store import Store
from restock.train.twin.env.vector_env import WarehouseVectorEnv

TERMS = """
[task.reward_terms]
close = [-0.5, "clearance_m < 2 * tight_clearance_m AND wheel_speed_mps > 0.4"]
swerve = [-0.2, "abs(gyro_yaw_rate_radps - lag(gyro_yaw_rate_radps, {0.4 s}) OVER episode)"]
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


def ingested(folder: Path, more: str) -> Store:
    """Return the store of a shipped recording by the shipped profile and `more`."""
    (folder / "own.toml").write_text(WAREHOUSE + more)
    tuesday, profile = ROOT / "sample_logs" / "amr_tuesday", folder / "own.toml"
    to = ["--profile", str(profile), "--store", str(folder / "store")]
    assert main(["ingest", str(tuesday), *to]) == 0
    return Store(folder / "store")


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> pa.Table:
    with ingested(tmp_path_factory.mktemp("plain"), "") as store:
        return store.sql("FROM transitions ORDER BY transition_id").to_arrow_table()


def test_terms_are_paid_by_the_step_that_a_transition_leads_to(plain, tmp_path):
    with ingested(tmp_path, TERMS) as store:
        rows = store.sql("FROM transitions ORDER BY transition_id").to_arrow_table()
    differ = {name for name in rows.column_names if not rows[name].equals(plain[name])}
    assert differ - {"ingest_id", "source_file"} == {"reward", "task_hash", "profile_hash"}
    paid = rows["reward"].to_numpy() - plain["reward"].to_numpy()
    step, speed, near, turn = (
        rows[name].to_numpy()
        for name in ("step_index", "wheel_speed_mps", "clearance_m", "gyro_yaw_rate_radps")
    )
    inside = np.flatnonzero(step[1:] == step[:-1] + 1)  # the step after is a row, too
    expected = -0.5 * ((near < 0.3) & (speed > 0.4))[inside + 1]
    swerve = 0.2 * np.abs(turn[inside + 1] - turn[inside - 1])
    expected -= np.where(step[inside] > 0, swerve, 0.0)  # two steps back is before the episode
    np.testing.assert_allclose(paid[inside], expected, atol=1e-6)
    assert len(np.unique(expected.round(1))) > 3


def test_a_term_on_a_custom_signal_is_paid_on_logs_alone(plain, tmp_path):
    with ingested(tmp_path, BATTERY) as store:
        rows = store.sql("FROM transitions ORDER BY transition_id").to_arrow_table()
    paid = (rows["reward"].to_numpy() - plain["reward"].to_numpy()).round(5)
    assert set(paid.tolist()) == {0.0, -1.0}
    task = load_profile(tmp_path / "own.toml").task
    with pytest.raises(ConfigError, match=r"reward_terms.low.*battery_v.*the twin does not fill"):
        WarehouseVectorEnv(1, task=task)


def drive(task: Task, steps: int, state: dict | None = None):
    """Return rewards (steps, 2), signals before and after each, and a state half-way."""
    env, rng = WarehouseVectorEnv(2, task=task, seed=3), np.random.default_rng(0)
    on_the_spot = [place for place, (speed, _) in enumerate(task.actions) if not speed]
    actions = rng.choice(on_the_spot, (steps, 2))
    env.reset(seed=3)
    if state is not None:
        env.load_state_dict(state)
        actions = actions[steps // 2 :]
    rewards, signals, middle = [], [env.signals], {}
    for index, action in enumerate(actions):
        if index == steps // 2:
            middle = env.state_dict()
        _, reward, terminated, truncated, info = env.step(action)
        assert not (terminated | truncated).any()
        rewards.append(reward)
        signals.append(info["signals"])
    return np.array(rewards), signals, middle


def test_the_twin_pays_what_ingest_would_and_resumes_to_the_bit():
    with_terms = parse_profile(WAREHOUSE + TERMS, where="own.toml").task
    rewards, signals, middle = drive(with_terms, 24)
    without, same, _ = drive(load_profile("warehouse_amr").task, 24)
    assert all(
        np.array_equal(one["pose_x_m"], two["pose_x_m"])
        for one, two in zip(signals, same, strict=True)
    )
    for robot in range(2):
        keys = {"episode_index": np.zeros(25, np.int64), "step_index": np.arange(25)}
        columns = {
            s.name: np.array([now[s.name][robot] for now in signals]) for s in STORED_SIGNALS
        }
        logged = pa.table(keys | columns).cast(steps_schema())
        expected = own_reward(with_terms, logged)[1:]
        np.testing.assert_array_equal(rewards[:, robot], without[:, robot] + expected)
        assert np.count_nonzero(expected) > 12
        assert np.array_equal(own_reward(with_terms, logged[:9])[1:], expected[:8])  # no future
    np.testing.assert_array_equal(drive(with_terms, 24, middle)[0], rewards[12:])


def test_without_terms_nothing_changes_and_each_word_counts():
    plain = load_profile("warehouse_amr")
    own = parse_profile(WAREHOUSE + TERMS, where="own.toml")
    assert "reward_terms" not in profile_toml(plain)
    assert parse_profile(profile_toml(own), where="carried") == own
    other = WAREHOUSE + TERMS.replace("-0.5", "-0.6")
    hashes = {plain.task.hash, own.task.hash, parse_profile(other, where="other.toml").task.hash}
    assert len(hashes) == 3


REFUSED = [
    ('x = [1, "lead(clearance_m) OVER episode"]', "lead() may look at later steps"),
    ('x = [1, "clearence_m < 1"]', 'Referenced column "clearence_m" not found'),
    ("x = [1, \"'much'\"]", "its SQL gives VARCHAR, not a number"),
    ('x = [1, "command_speed_mps"]', "which is chosen only after the step"),
    ('x = [1, "(SELECT 1)"]', "it contains a query"),
    ('x = [1, "random()"]', "reads data other than the steps"),
    ('goal = [1, "true"]', "'goal' is in [task.rewards]: choose another name"),
    ('"a b" = [1, "true"]', "a name is letters, digits and _"),
    ("x = [nan, 'true']", "must be finite"),
]


@pytest.mark.parametrize(("term", "what"), REFUSED)
def test_a_term_that_cannot_be_is_refused_by_name(term, what):
    with pytest.raises(ConfigError) as refused:
        parse_profile(f"{WAREHOUSE}\n[task.reward_terms]\n{term}\n", where="own.toml")
    assert what in str(refused.value)
    assert "reward_terms" in str(refused.value)


def without(text: str, *inputs: str) -> str:
    return re.sub(rf"(?ms)^\[inputs\.({'|'.join(inputs)})\].*?(?=^\[)", "", text)


HINDSIGHT = WAREHOUSE.replace("[clock]", '[goal]\nsource = "hindsight"\n\n[clock]', 1)


@pytest.mark.parametrize(
    ("text", "sql", "what"),
    [
        (without(WAREHOUSE, "scan"), "coalesce(clearance_m, 9)", "there is no lidar"),
        (without(HINDSIGHT, "goal", "plan"), "plan_gap_m", "the path that was driven"),
    ],
)
def test_a_term_on_what_is_unknown_is_refused(text, sql, what):
    with pytest.raises(ConfigError, match=what):
        parse_profile(f'{text}\n[task.reward_terms]\nx = [1, "{sql}"]\n', where="own.toml")


def test_a_term_that_pays_without_bound_is_refused():
    task = parse_profile(f'{WAREHOUSE}\n[task.reward_terms]\nx = [1, "exp(710)"]\n', where="").task
    steps = pa.table({name: [0] for name in ("episode_index", "step_index")})
    with pytest.raises(ConfigError, match="it pays inf for a step"):
        own_reward(task, steps)
