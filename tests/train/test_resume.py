"""Check that interrupted runs resume bit for bit, with every kind of saved state."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.long import one_in
from support.panels import LIMITED
from support.stores import CONDITIONS, recording_transitions
from support.toy_run import assert_same_run, config, run_to_end, session
from support.toy_twin import CONDITIONS as TOY_CONDITIONS
from support.toy_twin import TASK

from restock.ingest.task.conditions import Condition
from restock.replay.mixture.mixture import parse_mixture
from restock.replay.mixture.share_controller import PlannedDraws
from restock.replay.panel.build import build_panel
from restock.train.dqn.config import TrainConfig
from restock.train.evaluation.evaluate import EpisodeResult
from restock.train.feed.logs import Logs
from restock.train.loop import TrainingInterrupted, train
from restock.train.run import checkpoint
from restock.train.session import Session

# Few logged rows, so that fresh rows fill the quotas too.
QUOTAS = "max_replays_per_row = 8\n" + "".join(
    f"[[strata]]\nname = '{name}'\nunit = 'episode'\nshare = 0.5\n"
    for name in ("nominal", "wheel_slip")
)
SHORT = {"env_steps": 480}


class RandomTeacher:
    """Teacher that draws random actions, so that its state matters."""

    def __init__(self) -> None:
        self.rng = np.random.default_rng(1)

    def act(self, env: Any, observation: np.ndarray) -> np.ndarray:
        return self.rng.integers(3, size=len(observation))

    def state_dict(self) -> dict[str, Any]:
        return dict(self.rng.bit_generator.state)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.rng.bit_generator.state = state


def logs_of_mixture(text: str, conditions: Iterable[Condition]) -> Callable[[Path], Logs]:
    def made(folder: Path) -> Logs:
        rows = pa.concat_tables([recording_transitions(n, task=TASK) for n in (1, 2, 3)])
        mixture = parse_mixture(f"discount = 0.9\n{text}")
        panel = build_panel(rows, mixture, folder / "p", task=TASK, conditions=list(conditions))
        return Logs.of_panel(panel, PlannedDraws(60 * 32, 70 * 32, 200, 480))

    return made


CASES: dict[str, tuple[dict[str, Any], Callable[[Path], Logs] | None, Callable[[], Any]]] = {
    # Every batch is audited, so rows wait for labels of running episodes.
    "network, ring, twin, tables": ({"record": {"audit_share": 1.0}}, None, lambda: None),
    "every term of the loss": (
        {"loss": {"margin": 0.5, "conservative": 0.1}, "target": {"rule": "hard", "every": 13}},
        None,
        lambda: None,
    ),
    "a teacher and its filter": (
        {"teacher": {"source": "given", "ratio": 0.5, "offline_updates": 40}},
        None,
        RandomTeacher,
    ),
    "navigation's proposals": ({"teacher": {"source": "planner"}}, None, lambda: None),
    "practice": ({"practice": {"rule": "success"}}, None, lambda: None),
    "shares of logged rows": (
        {"replay": {"logs_share": None}},
        logs_of_mixture(LIMITED, CONDITIONS),
        lambda: None,
    ),
    "quotas that fresh rows fill": (
        {"replay": {"logs_share": None}},
        logs_of_mixture(QUOTAS, TOY_CONDITIONS),
        lambda: None,
    ),
}


def train_until(live: Session, stop: Callable[[], bool]) -> None:
    with pytest.raises(TrainingInterrupted, match="restock train --resume"):
        train(live, stop=stop)
    live.close()


@pytest.mark.parametrize("case", CASES)
def test_interrupted_run_matches_uninterrupted_run(case, tmp_path, monkeypatch):
    monkeypatch.setattr("restock.train.feed.practice.INTERVAL_STEPS", 100)
    monkeypatch.setattr("restock.train.feed.practice.WARMUP_EPISODES", 2)
    changes, make_logs, teacher = CASES[case]
    settings = config(**{**changes, "schedule": SHORT})
    logs = {} if make_logs is None else {"logs": make_logs(tmp_path)}

    def opened(name: str, *, resume: bool = False) -> Session:
        return session(tmp_path / name, settings, teacher=teacher(), resume=resume, **logs)

    whole = opened("whole")
    train(whole)
    whole.close()
    # Interrupt once offline and once online.
    cut = opened("cut")
    train_until(cut, lambda: cut.learner.gradient_steps >= 20)
    again = opened("cut", resume=True)
    train_until(again, lambda: again.progress.env_steps >= 350)
    last = opened("cut", resume=True)
    train(last)
    last.close()
    assert_same_run(whole, last)
    if case == "practice":
        rows = whole.run.table("practice").to_pylist()
        assert len({row["wanted_share"] for row in rows}) > 2  # the shares did change
        assert sum(row["episodes"] for row in rows) == whole.run.table("episodes").num_rows


@pytest.fixture(scope="module")
def settings() -> TrainConfig:
    return config(schedule={"env_steps": 800}, evaluation={"every_env_steps": 400})


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory, settings: TrainConfig) -> Session:
    return run_to_end(tmp_path_factory.mktemp("runs") / "undisturbed", settings)


def resume_and_train(path: Path, settings: TrainConfig) -> Session:
    live = session(path, settings, resume=True)
    train(live)
    live.close()
    return live


@pytest.mark.parametrize("evaluation", one_in(2, [1, 2, 3]))
def test_resume_repeats_abandoned_evaluation(undisturbed, settings, tmp_path, evaluation):
    """Abandon the evaluation after the offline phase, during online updates, or at the end."""
    path = tmp_path / "a"
    live = session(path, settings)
    steps = iter(range(4))
    begun, drive = [], live.evaluation_buffer.drive

    def driving(*args: Any, **kwargs: Any) -> list[EpisodeResult]:
        begun.append(live.progress.env_steps)
        return drive(*args, **kwargs)

    live.evaluation_buffer.drive = driving  # type: ignore[method-assign]
    train_until(live, lambda: len(begun) == evaluation and next(steps, None) is None)
    assert begun == [0, 400, 800][:evaluation]
    evaluated = pq.read_table(path / "evaluations.parquet")["env_steps"].unique().to_pylist()
    assert evaluated == begun[:-1]
    assert_same_run(undisturbed, resume_and_train(path, settings))


def test_killed_run_resumes_from_checkpoint(undisturbed, settings, tmp_path):
    class Killed(Exception):
        pass

    path = tmp_path / "a"
    live = session(path, settings)

    def kill(event: str, values: dict[str, Any]) -> None:
        if event == "progress" and values["env_steps"] > 500:
            raise Killed

    with pytest.raises(Killed):
        train(live, notify=kill)
    live.close()
    assert 0 < checkpoint.load(live.run.latest)["progress"]["env_steps"] < live.progress.env_steps
    assert_same_run(undisturbed, resume_and_train(path, settings))
