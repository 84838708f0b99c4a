"""Check teachers: the filter of plausible actions, the greedy choice, sources and saved state."""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from support.paths import ROOT
from support.toy_run import config, logs, run_to_end, session
from support.toy_twin import CELLS, TASK
from torch import Tensor, tensor

from restock.cli.learning.train import describe_run
from restock.errors import ConfigError
from restock.ingest.profile.profile import load_profile
from restock.ingest.task.task import Mirror
from restock.replay.sampling.ring import FreshRing
from restock.state import restored, saved
from restock.train.dqn.behaviour import UNKNOWN, Labelled, imitation_loss, plausible_actions
from restock.train.dqn.config import TeacherConfig, parse_config
from restock.train.dqn.learner import Learner, greedy_actions
from restock.train.feed.teacher import Imitation, TeacherFailed, open_teacher
from restock.train.loop import train
from restock.train.prepare import prepare_new, prepare_resumed
from restock.train.run.run import Run
from restock.train.twin.env.vector_env import WarehouseVectorEnv

STOP, FORWARD, BACK = range(3)


@given(st.floats(0, 1), st.integers(0, 2**32 - 1))
def test_plausible_actions_match_probability_ratio(ratio: float, seed: int) -> None:
    logits = torch.randn(6, 4, generator=torch.Generator().manual_seed(seed)).double()
    found = plausible_actions(logits, tensor(ratio, dtype=torch.float64))
    probability = logits.softmax(dim=1)
    largest = probability.amax(dim=1, keepdim=True)
    near = (probability / largest - ratio).abs() < 1e-9
    assert bool(((probability >= ratio * largest) == found)[~near].all())
    assert bool(found.any(dim=1).all())
    assert bool(found.gather(1, probability.argmax(dim=1, keepdim=True)).all())


def test_imitation_loss_skips_unlabelled_states() -> None:
    logits = tensor([[0.5, 0.25, 0.25], [0.1, 0.1, 0.8], [0.2, 0.2, 0.6]]).log() + 2.5
    expected = -(np.log(0.5) + np.log(0.6)) / 2
    assert float(imitation_loss(logits, tensor([0, UNKNOWN, 2]))) == pytest.approx(expected)
    assert float(imitation_loss(logits, torch.full((3,), UNKNOWN))) == 0


def make_teacher_learner(path: Any = None, **sections: dict[str, Any]) -> Learner:
    document: dict[str, Any] = {"network": {"hidden": (16,)}, "teacher": {"source": "logs"}}
    document |= sections
    return Learner(parse_config(document, where="test"), 6, 3, path=path)


def rows(seed: int) -> Tensor:
    packed = torch.randn(32, 15, generator=torch.Generator().manual_seed(seed))
    packed[:, -3] = torch.arange(32) % 3
    packed[:, -1] = 0.9 * (torch.arange(32) % 5 != 0)
    return packed


def test_implausible_actions_are_not_chosen_or_bootstrapped() -> None:
    learner = make_teacher_learner()
    behaviour = learner.behaviour
    assert behaviour is not None
    state = torch.eye(6)
    for _ in range(200):
        behaviour.learn(Labelled(state, torch.full((6,), FORWARD)))
    assert behaviour.preference(state).tolist() == [[-np.inf, 0, -np.inf]] * 6
    with torch.no_grad():
        learner.network.advantage.bias.copy_(tensor([9.0, 0.0, 5.0]))
    assert greedy_actions(learner.network, state.numpy()).tolist() == [STOP] * 6
    assert learner.greedy(state.numpy()).tolist() == [FORWARD] * 6
    unfiltered = make_teacher_learner(teacher={"source": "logs", "ratio": 0.0})
    unfiltered.load_state_dict(learner.state_dict())
    assert unfiltered.greedy(state.numpy()).tolist() == [STOP] * 6


def forward(env: Any, observation: np.ndarray) -> np.ndarray:
    """Answer FORWARD in every cell but the first, where the answer is UNKNOWN."""
    return np.where(observation[:, 0] == 1, UNKNOWN, FORWARD)


TAUGHT = {"teacher": {"source": "given", "ratio": 0.5, "offline_updates": 40}}


@pytest.fixture(scope="module")
def taught(tmp_path_factory: pytest.TempPathFactory) -> Any:
    path = tmp_path_factory.mktemp("taught") / "run"
    return run_to_end(path, config(**TAUGHT), teacher=forward)


def test_each_step_stores_teacher_action_of_its_state(taught: Any) -> None:
    ring, count = taught.ring, len(taught.ring)
    label = ring.meta["teacher_action"][:count]
    first = ring.rows[:count, 0] == 1
    assert first.any()
    assert (label[first] == UNKNOWN).all()
    assert (label[~first] == FORWARD).all()
    epsilon = taught.config.epsilon.at(taught.progress.env_steps)
    late = ring.meta["env_step"][:count] > 1200
    probability = ring.meta["action_probability"][:count][late]
    chosen = ring.rows[:count, -3][late] == FORWARD
    assert probability[chosen].min() == pytest.approx(1 - epsilon + epsilon / 3)
    assert probability[~chosen].max() == pytest.approx(epsilon / 3)  # explores over all actions


def test_offline_cloning_filters_actions_before_driving(tmp_path: Path) -> None:
    teacher = {"source": "logs", "ratio": 0.5, "offline_updates": 200}
    live = session(tmp_path / "a", config(teacher=teacher, schedule={"env_steps": 4}))
    assert live.imitation is not None
    policy = logs().behaviour_policy
    operators = np.flatnonzero(policy.codes == policy.names.index("operator"))
    assert np.isin(live.imitation.cloned, operators).all()
    train(live)
    behaviour = live.learner.behaviour
    assert behaviour is not None
    assert behaviour.updates == 200
    # Seven of ten logged steps go forward: no other action is half as likely.
    cells = torch.zeros(CELLS - 1, TASK.observation_size)
    cells[range(CELLS - 1), range(CELLS - 1)] = 1
    assert live.learner.greedy(cells.numpy()).tolist() == [FORWARD] * (CELLS - 1)
    live.close()


def test_cloned_rows_are_drawn_by_stratum_shares(tmp_path: Path) -> None:
    live = session(tmp_path / "a", config(teacher={"source": "logs"}))
    imitation, shelf = live.imitation, logs()
    assert imitation is not None
    chance = np.diff(imitation._online.cumulative, prepend=0.0)
    for share, members in zip(shelf.shares, shelf.stratum_rows, strict=True):
        inside = np.isin(imitation.cloned, members)
        assert chance[inside].sum() == pytest.approx(share)
        assert np.ptp(chance[inside]) < 1e-9
    live.close()


def test_half_of_imitation_rows_are_mirrored(tmp_path: Path) -> None:
    task = load_profile("warehouse_amr").task
    ring = FreshRing(
        4,
        1,
        task.observation_size,
        discount=0.9,
        n_step=1,
        conditions=["nominal"],
        behaviour_policies=["agent"],
    )
    rng = np.random.default_rng(0)
    observed = rng.normal(size=(4, task.observation_size)).astype(np.float32)
    answers = np.array([3, UNKNOWN, 8, 0])
    ring.rows[:, ring.columns["observation"]] = observed
    ring.meta["teacher_action"][:] = answers
    ring.appended = 4
    mirror = Mirror.of(task)
    imitation = Imitation(
        TeacherConfig(source="operator"), None, ring, batch_size=400, seed=0, mirror=mirror
    )
    drawn = imitation.draw_online()
    both = (
        (False, observed, answers),
        (True, mirror.observation(observed), mirror.action(answers)),
    )
    expected = {
        row.tobytes(): (turned, action)
        for turned, rows, actions in both
        for row, action in zip(rows, actions, strict=True)
    }
    found = [expected[row.tobytes()] for row in drawn.observation.numpy()]
    assert [action for _, action in found] == drawn.action.tolist()
    assert 150 < sum(turned for turned, _ in found) < 250
    assert np.array_equal(ring.rows[:, ring.columns["observation"]], observed)


def test_mirroring_defaults_to_on_for_operator_teacher(tmp_path):
    def mirror(*settings: str) -> bool | None:
        return prepare_new(tmp_path / "run", None, None, settings).config.teacher.mirror

    assert mirror() is True
    assert mirror("teacher.mirror=false") is False
    assert mirror("teacher.source=none") is False
    text = (ROOT / "ingest/profile/profiles/warehouse_amr.toml").read_text("utf-8")
    lopsided = tmp_path / "lopsided.toml"
    assert "[0.8, -0.7]" in text
    lopsided.write_text(text.replace("[0.8, -0.7]", "[0.8, -0.6]"))
    assert mirror(f"profile={lopsided}") is False
    with pytest.raises(ConfigError, match=r"drive 0\.8 left 0\.7, has no opposite"):
        mirror(f"profile={lopsided}", "teacher.mirror=true")
    prepared = prepare_new(tmp_path / "run", None, None, [f"profile={lopsided}"])
    Run.create(tmp_path / "run", prepared.document)
    with pytest.raises(ConfigError, match="has no opposite"):
        prepare_resumed(tmp_path / "run", ["teacher.mirror=true"])


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (None, "returned nothing, not 4 whole numbers"),
        ([1, 1], r"returned int64 \(2,\), not 4"),
        ([1.0, 1.0, 1.0, 1.0], r"returned float64 \(4,\)"),
        ([1, 1, 3, 1], "returned action 3 for environment 2: the task's are 0 to 2"),
        ([1, -2, 0, 1], "returned action -2 for environment 1"),
        ([[1], [1, 2], [0], [1]], "returned a list that is not an array"),
    ],
)
def test_invalid_teacher_answers_are_rejected(answer, message, tmp_path):
    live = session(tmp_path / "a", config(**TAUGHT), teacher=lambda env, observation: answer)
    with pytest.raises(ConfigError, match=message):
        train(live)
    live.close()
    assert live.progress.online_updates == 0


TEACHERS = """
import numpy as np

def broken(env, observation):
    return np.ones(int("three"))

def ended(env, observation):
    raise SystemExit(0)

class Made:
    def __init__(self, needed):
        pass
"""


@pytest.mark.parametrize(
    ("source", "message", "line"),
    [
        # Errors in a call, in the constructor and on import; the line is the user's own.
        ("mine:broken", "mine:broken raised ValueError", 5),
        ("mine:ended", "mine:ended raised SystemExit", 8),
        ("mine:Made", "making the teacher mine:Made raised TypeError", 10),
        ("unreadable:act", "importing unreadable:act raised SyntaxError", 2),
    ],
)
def test_teacher_exception_reports_file_and_line(source, message, line, tmp_path, monkeypatch):
    (tmp_path / "mine.py").write_text(TEACHERS)
    (tmp_path / "unreadable.py").write_text("\ndef act(:\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "mine", raising=False)
    settings = config(teacher={**TAUGHT["teacher"], "source": source})
    with pytest.raises(ConfigError, match=message) as refused:
        train(session(tmp_path / "a", settings))
    file = f"{source.partition(':')[0]}.py"
    assert str(refused.value.where).endswith(f"{file}:{line}")


def test_run_resumes_after_teacher_failure(tmp_path: Path) -> None:
    calls = 0

    def late(env: Any, observation: np.ndarray) -> np.ndarray | None:
        nonlocal calls
        calls += 1
        return None if calls > 100 else forward(env, observation)

    settings = config(**TAUGHT, schedule={"env_steps": 800})
    live = session(tmp_path / "a", settings, teacher=late)
    with pytest.raises(TeacherFailed, match=r"returned nothing.*; a checkpoint was written"):
        train(live)
    live.close()
    assert live.progress.env_steps == 400
    assert live.progress.online_updates > 0
    again = session(tmp_path / "a", settings, teacher=forward, resume=True)
    assert again.progress.env_steps == 400
    np.testing.assert_array_equal(again.ring.rows, live.ring.rows)
    result = train(again)
    again.close()
    assert result.env_steps == 800
    assert again.progress.online_updates == int(
        (800 - again.progress.online_from) * settings.schedule.updates_per_env_step
    )


def test_unusable_teachers_are_rejected(tmp_path: Path) -> None:
    live = session(tmp_path / "a", config(teacher={"source": "operator"}))
    with pytest.raises(ConfigError, match="needs the warehouse twin, but this is a ToyTwin"):
        train(live)
    live.close()
    for source, message in (
        ("no_such_module:name", "cannot be imported: No module named"),
        ("restock.errors:nobody", "has no attribute 'nobody'"),
        ("restock.train.dqn.behaviour:UNKNOWN", "is a int, which has no act"),
        ("given", "passed in from Python, and none is given now"),
    ):
        with pytest.raises(ConfigError, match=message):
            session(tmp_path / source, config(teacher={"source": source}))


@pytest.mark.parametrize(
    ("parts", "message"),
    [({"logs": None}, "this run has no logs"), ({}, "the logs have planner, operator\n")],
)
def test_missing_rows_to_clone_are_rejected(parts, message, tmp_path):
    settings = config(teacher={"source": "logs", "policies": ["teleop"]})
    with pytest.raises(ConfigError, match=f"clones the rows of teleop, but {message}"):
        session(tmp_path / "a", settings, **parts)


def test_teacher_table_records_filter_statistics(taught: Any) -> None:
    rows = taught.run.table("teacher").to_pylist()
    assert {(row["source"], row["condition"]) for row in rows} >= {
        ("logs", "nominal"),
        ("fresh", "nominal"),
        ("fresh", "near_goal"),
    }
    last = [row for row in rows if row["env_steps"] == taught.progress.env_steps]
    for row in last:
        assert 0 < row["asked_rows"] <= row["rows"] <= 128
        assert 1 <= row["plausible_actions"] <= 3
        assert row["teacher_plausible"] >= row["agreement"]
        assert row["ratio"] == 0.5
    fresh = [row for row in last if row["source"] == "fresh"]
    assert all(row["agreement"] == row["chosen_agreement"] == 1 for row in fresh)  # always FORWARD
    near = [row["loss"] for row in rows if row["condition"] == "near_goal"]
    assert near[-1] < near[0]


def test_operator_teacher_restores_its_state() -> None:
    task = load_profile("warehouse_amr").task
    teacher = open_teacher(TeacherConfig(source="operator"), task, seed=0)
    assert teacher is not None
    env = WarehouseVectorEnv(3, seed=5)
    observation, _ = env.reset(seed=5)

    def drive(steps: int) -> list[list[int]]:
        answers = []
        for _ in range(steps):
            answers.append(teacher.query(env, observation).tolist())
            env.step(np.array(answers[-1]))
        return answers

    drive(12)
    before = json.loads(json.dumps(saved(teacher), default=np.ndarray.tolist))
    world = env.state_dict()
    first = drive(8)
    env.load_state_dict(world)
    restored(teacher, before)
    assert drive(8) == first
    assert len({action for answers in first for action in answers}) > 1


def test_operator_is_default_teacher_for_goal_tasks(tmp_path: Path) -> None:
    def source(*settings: str) -> str | None:
        return prepare_new(tmp_path / "run", None, None, settings).config.teacher.source

    assert source() == "operator"
    assert source("teacher.source=none") == "none"
    text = (ROOT / "ingest/profile/profiles/warehouse_amr.toml").read_text("utf-8")
    aimless = tmp_path / "aimless.toml"
    aimless.write_text(text.replace('goal = "route"', 'goal = "none"'))
    assert source(f"profile={aimless}") == "none"
    assert (
        "teacher operator: the policy chooses by Q among the actions that it finds plausible"
        in describe_run(prepare_new(tmp_path / "run", None, None))
    )
