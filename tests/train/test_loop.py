"""Check the training loop on a corridor: learning, records, repeatability and resuming."""

import dataclasses
import shutil
from concurrent.futures import Executor, Future
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from support.toy_run import assert_same_run, config, logs, run_to_end, session
from support.toy_twin import CELLS, CONDITIONS, TASK, ToyTwin

from restock.cli.learning.train import explain_no_update
from restock.errors import ConfigError, RunError
from restock.ingest.task.conditions import Condition
from restock.train import session as session_module
from restock.train.dqn.learner import Learner
from restock.train.evaluation.evaluate import EvaluationBuffer, fixed_episodes
from restock.train.evaluation.policies import GreedyPolicy, load_agent
from restock.train.feed.batches import LogTerms
from restock.train.feed.logs import Coded
from restock.train.loop import nothing_to_do, train
from restock.train.run import checkpoint
from restock.train.run.run import Run
from restock.train.session import Session


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Session:
    return run_to_end(tmp_path_factory.mktemp("runs") / "undisturbed", config())


@pytest.mark.long
def test_corridor_is_solved_without_logs(tmp_path: Path) -> None:
    live = run_to_end(tmp_path / "a", config(schedule={"env_steps": 6000}), logs=None)
    assert live.best is not None
    assert live.best.success == {"nominal": 1.0, "wheel_slip": 1.0}
    # Forward is the best action in every cell.
    cells = np.zeros((CELLS - 1, TASK.observation_size), np.float32)
    cells[np.arange(CELLS - 1), np.arange(CELLS - 1)] = 1
    assert live.learner.greedy(cells).tolist() == [1] * (CELLS - 1)
    assert live.learner.gradient_steps > 1000


@pytest.mark.parametrize("with_logs", [True, False])
def test_spent_budget_still_makes_one_interval_of_updates(tmp_path, with_logs):
    """Make at least one interval of updates, so that slow machines keep a policy too."""
    settings = config(schedule={"seconds": 1e-9, "offline_updates": 1000, "env_steps": 6000})
    live = run_to_end(tmp_path / "a", settings, **({} if with_logs else {"logs": None}))
    least = settings.record.every_updates
    assert least <= live.learner.gradient_steps <= least + 20
    assert live.best is not None
    (row, *_) = [row for row in live.run.table("progress").to_pylist() if row["updates"]]
    assert row["loss"] is not None
    assert (live.progress.env_steps == 0) == with_logs


def test_half_of_seconds_budget_is_online(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Split the time, so that the policy drives even with few logs and a slow twin."""
    seconds = count(step=0.01)  # a clock that advances on each call
    monkeypatch.setattr(session_module, "time", SimpleNamespace(monotonic=lambda: next(seconds)))
    settings = config(schedule={"seconds": 3.0, "offline_updates": 10**6, "env_steps": 10**6})
    live = session(tmp_path / "a", settings)
    live._started = 0.0
    train(live)
    live.close()
    assert live.progress.driving_from_s == pytest.approx(1.5, abs=0.1)
    assert live.progress.env_steps > 0
    assert live.learner.gradient_steps < 10**6
    # The budget includes the final evaluation.
    assert live.progress.planned_env_steps < 10**6


class ImmediateExecutor(Executor):
    """Executor that runs work at once, in the calling thread."""

    def submit(self, work: Any, /, *args: Any, **named: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_result(work(*args, **named))
        return future


def test_simulation_thread_does_not_change_results(undisturbed, tmp_path, monkeypatch):
    monkeypatch.setattr("restock.train.session.ThreadPoolExecutor", lambda *_: ImmediateExecutor())
    assert_same_run(undisturbed, run_to_end(tmp_path / "alone", config()))


def test_resume_on_other_logged_rows_is_rejected(tmp_path: Path) -> None:
    settings = config(schedule={"env_steps": 400})
    first = run_to_end(tmp_path / "run", settings)
    probe = pq.read_table(first.run.path / "probe.parquet")["probe_hash"].unique().to_pylist()
    other = dataclasses.replace(logs(), rows=logs().rows.flip(0))
    with pytest.raises(RunError, match=rf"other logged rows: its probe is {probe[0]}") as refused:
        session(first.run.path, settings, logs=other, resume=True)
    assert "the panel that the run began with" in str(refused.value)


@pytest.mark.parametrize("damage", ["missing", "cut"])
def test_run_without_best_checkpoint_is_rejected(undisturbed, tmp_path, damage):
    path = Path(shutil.copytree(undisturbed.run.path, tmp_path / "run"))
    best = path / "checkpoints" / "best.safetensors"
    content = best.read_bytes()
    best.unlink()
    if damage == "cut":
        best.write_bytes(content[: len(content) // 2])
    document = {"config": msgspec.to_builtins(config())}
    run = Run(path, document)
    for use in (lambda: session(path, config(), resume=True), lambda: load_agent(run)):
        with pytest.raises(RunError, match=r"has kept a policy there|is damaged") as refused:
            use()
        assert refused.value.where == str(best)
        assert "restore it from a copy" in str(refused.value.remedy)
    assert pq.read_table(path / "progress.parquet").equals(undisturbed.run.table("progress"))


def test_half_of_online_batch_is_logged_by_quota(undisturbed: Session) -> None:
    strata = pq.read_table(undisturbed.run.path / "strata.parquet").to_pylist()
    offline = [row for row in strata if row["phase"] == "offline"]
    assert {row["source"] for row in offline} == {"logs"}
    online = [row for row in strata if row["phase"] == "online"]
    for clock in {row["gradient_steps"] for row in online}:
        interval = [row for row in online if row["gradient_steps"] == clock]
        drawn = {
            source: sum(row["drawn_rows"] for row in interval if row["source"] == source)
            for source in ("logs", "fresh")
        }
        assert drawn["logs"] == drawn["fresh"] > 0
        slip = next(r for r in interval if r["source"] == "logs" and r["stratum"] == "wheel_slip")
        assert slip["drawn_share"] == pytest.approx(0.25, abs=1e-3)
        assert slip["quota_share"] == 0.25
        assert slip["timing"] == "post"


def test_every_drawn_row_is_counted(undisturbed: Session) -> None:
    path = undisturbed.run.path
    steps = undisturbed.learner.gradient_steps
    drawn = pq.read_table(path / "strata.parquet")
    assert sum(drawn["drawn_rows"].to_pylist()) == steps * 32
    last = {(row["source"], row["stratum"]): row["total_drawn_rows"] for row in drawn.to_pylist()}
    assert sum(last.values()) == steps * 32
    assert sum(pq.read_table(path / "policies.parquet")["rows"].to_pylist()) == steps * 32
    by_condition = pq.read_table(path / "conditions.parquet").to_pylist()
    assert sum(row["drawn_rows"] for row in by_condition) == steps * 32
    own = {(r["gradient_steps"], r["source"], r["stratum"]): r for r in drawn.to_pylist()}
    for row in by_condition:  # the strata of this panel are conditions
        stratum = own[row["gradient_steps"], row["source"], row["condition"]]
        for name in ("phase", "drawn_rows", "drawn_share", "effective_share", "td_abs_mean"):
            assert row[name] == pytest.approx(stratum[name]), name
    fed = pq.read_table(path / "sampled_episodes.parquet").to_pylist()
    assert sum(row["drawn_rows"] for row in fed) == steps * 32
    assert {row["episode"] for row in fed if row["source"] == "logs"} == {"a/0"}
    assert len({row["episode"] for row in fed if row["source"] == "fresh"}) > 50
    ages = pq.read_table(path / "ages.parquet").to_pylist()
    by_unit = {
        unit: sum(r["count"] for r in ages if r["unit"] == unit) for unit in ("days", "env_steps")
    }
    assert sum(by_unit.values()) == steps * 32
    assert sum(pq.read_table(path / "progress.parquet")["updates"].to_pylist()) == steps


def test_critic_is_measured_on_evaluation_steps(undisturbed: Session) -> None:
    path = undisturbed.run.path
    evaluated = set(pq.read_table(path / "evaluations.parquet")["gradient_steps"].to_pylist())
    measured = pq.read_table(path / "evaluation_buffer.parquet").to_pylist()
    assert {row["gradient_steps"] for row in measured} == evaluated
    assert {row["condition"] for row in measured} >= {"nominal", "wheel_slip"}
    assert all(row["rows"] > 0 and row["td_abs_mean"] > 0 for row in measured)


def test_evaluation_is_repeatable(tmp_path: Path) -> None:
    live = session(tmp_path / "a", config())
    policy = GreedyPolicy(live.learner.policy_network)
    specs = fixed_episodes(["nominal", "wheel_slip"], 4, 7)  # 8 episodes in 3 corridors

    def measured() -> tuple[int, list[dict[str, Any]]]:
        driven = live.evaluation_buffer.drive(policy, specs)
        steps = round(sum(result.time_s for result in driven) / TASK.control_period_s)
        return steps, live.evaluation_buffer.measure(live.learner)

    steps, first = measured()
    assert measured() == (steps, first)
    # Steps that environments make after their episodes have ended are not counted.
    assert sum(row["rows_met"] for row in first) == steps
    live.close()


def test_audit_rows_match_drawn_rows(undisturbed: Session) -> None:
    audit = pq.read_table(undisturbed.run.path / "audit.parquet").to_pylist()
    batches = {row["gradient_step"] for row in audit}
    assert len(audit) == 32 * len(batches)
    assert 0.05 < len(batches) / undisturbed.learner.gradient_steps < 0.2
    shelf = logs()
    for row in audit:
        assert row["last_target_sync"] == row["gradient_step"] - 1  # Polyak: after every update
        if row["source"] == "logs":
            packed = shelf.rows[row["transition_id"] - 1000]
            assert row["action"] == int(packed[-3])
            assert row["reward"] == pytest.approx(float(packed[-2]))
            assert row["behaviour_policy"] in ("planner", "operator")
            stamp = shelf.stamp_ns[row["transition_id"] - 1000] / 86_400e9
            assert row["age_days"] == pytest.approx(10 - stamp)
            assert row["age_gradient_steps"] == row["gradient_step"]  # drawable from the start
        else:
            assert row["behaviour_policy"] == "dqn"
            assert row["age_env_steps"] >= 0
            assert row["perturbation"] == "worn"
            assert dict(row["perturbation_values"]) == {"gain": 0.9}
            assert row["age_gradient_steps"] >= 0
            assert row["ring_slot"] is not None


def test_finished_episodes_are_labelled_in_the_ring(undisturbed: Session) -> None:
    episodes = pq.read_table(undisturbed.run.path / "episodes.parquet").to_pylist()
    slipping = [row for row in episodes if row["true_condition"] == "wheel_slip"]
    assert slipping
    assert not any("wheel_slip" in r["conditions"] for r in episodes if r not in slipping)
    assert sum("wheel_slip" in row["conditions"] for row in slipping) > 0.8 * len(slipping)
    ring = undisturbed.ring
    names = ring.conditions
    slip_rows = ring.rows[: len(ring)][
        ring.condition(np.arange(len(ring))) == names.index("wheel_slip")
    ]
    # Only forward commands can slip.
    assert len(slip_rows)
    assert set(slip_rows[:, -3].tolist()) == {1.0}


def test_run_records_target_rule_and_lag(undisturbed: Session, tmp_path: Path) -> None:
    progress = pq.read_table(undisturbed.run.path / "progress.parquet").to_pylist()
    learning = [row for row in progress if row["updates"]]
    assert {row["target_rule"] for row in learning} == {"polyak tau 0.05"}
    assert all(row["target_param_distance"] > 0 and row["target_q_lag"] > 0 for row in learning)
    assert {row["steps_since_sync"] for row in learning} == {0}
    probe = pq.read_table(undisturbed.run.path / "probe.parquet").to_pylist()
    assert {row["condition"] for row in probe} == {"nominal", "wheel_slip"}
    assert len({row["probe_hash"] for row in probe}) == 1

    hard = run_to_end(tmp_path / "hard", config(target={"rule": "hard", "every": 25}))
    rows = pq.read_table(hard.run.path / "progress.parquet").to_pylist()
    full = [row for row in rows if row["updates"] == 50]
    # Each interval ends on a sync, where the distance is 0, so it is logged just before.
    assert {row["target_sampled"] for row in full} == {"before_sync"}
    assert all(row["target_param_distance"] > 0 and row["target_q_lag"] > 0 for row in full)
    assert {row["steps_since_sync"] for row in full} == {0}


def test_best_checkpoint_has_best_evaluation(undisturbed: Session) -> None:
    best = checkpoint.load(undisturbed.run.best)
    rows = pq.read_table(undisturbed.run.path / "evaluations.parquet").to_pylist()
    marked = {row["env_steps"] for row in rows if row["best"]}
    assert best["env_steps"] == max(marked)
    means = {
        step: np.mean([row["success"] for row in rows if row["env_steps"] == step])
        for step in {row["env_steps"] for row in rows}
    }
    assert means[best["env_steps"]] == max(means.values())
    assert {row["episode_seed"] for row in rows} == {90_000, 90_001, 90_002}


def test_warmup_collects_without_learning(tmp_path):
    settings = config(schedule={"env_steps": 400, "warmup_env_steps": 400})
    live = session(tmp_path / "a", settings, logs=None)
    text = explain_no_update(train(live), settings)
    live.close()
    assert live.learner.gradient_steps == 0
    assert len(live.ring) > 300
    assert text is not None
    assert text.startswith("no update was made in 400 environment steps")
    assert "schedule.warmup_env_steps=400" in text


def test_resume_reports_spent_budget(undisturbed: Session, tmp_path: Path) -> None:
    path = Path(shutil.copytree(undisturbed.run.path, tmp_path / "run"))

    def idle_reason(**schedule: Any) -> str:
        live = session(path, config(schedule=schedule), resume=True)
        live.close()
        return nothing_to_do(live) or "goes on"

    assert (
        idle_reason()
        == "its budget of 1,600 environment steps is used up; give more with --env-steps N"
    )
    assert idle_reason(env_steps=2000) == "goes on"
    used_up = idle_reason(env_steps=2000, seconds=1e-9)
    assert used_up == "its budget of 1e-09 s is used up; give more with --seconds S"
    undisturbed.progress.evaluated_at, before = 800, undisturbed.progress.evaluated_at
    assert nothing_to_do(undisturbed) is None  # its last evaluation was abandoned
    undisturbed.progress.evaluated_at = before


def test_finished_run_is_unchanged_by_resume(tmp_path: Path) -> None:
    settings = config(schedule={"env_steps": 1200}, record={"trackers": ["tensorboard"]})
    done = session(tmp_path / "run", settings)
    outcome = train(done)
    done.close()

    def files() -> dict[Path, tuple[int, bytes]]:
        found = (file for file in done.run.path.rglob("*") if file.is_file())
        return {file: (file.stat().st_mtime_ns, file.read_bytes()) for file in found}

    before = files()
    assert any("tensorboard" in file.parts for file in before)
    for _ in range(2):
        again = session(done.run.path, settings, resume=True)
        assert train(again).env_steps == outcome.env_steps == 1200
        again.close()
    assert files() == before


def test_kept_policy_averages_weights(monkeypatch):
    rows = logs().rows[:32].clone()
    for rate in (1.0, 0.25):
        monkeypatch.setattr("restock.train.dqn.network.AVERAGING", rate)
        learner = Learner(config(), TASK.observation_size, 3)
        seen = []
        for _ in range(6):
            learner.update(rows)
            seen.append(learner.network.advantage.bias.detach().clone())
        # The mean of the first four, then an exponential average with rate .25.
        expected = seen[-1]
        if rate == 0.25:
            expected = torch.stack(seen[:4]).mean(dim=0)
            for weights in seen[4:]:
                expected = expected + 0.25 * (weights - expected)
        assert torch.allclose(learner.policy_network.advantage.bias, expected, atol=1e-6)


def test_conservative_loss_lowers_unlogged_actions(tmp_path: Path) -> None:
    """Train offline on rows that only drive forward, so other actions have arbitrary values."""
    shelf = logs(400)
    forward = np.flatnonzero(shelf.rows[:, -3].numpy() == 1)
    alone = {"strata": ["nominal"], "timings": ["pre"], "stratum_rows": [forward]}
    shelf = dataclasses.replace(shelf, **alone, shares=np.ones(1))
    cells = torch.zeros(CELLS - 1, TASK.observation_size)
    cells[torch.arange(CELLS - 1), torch.arange(CELLS - 1)] = 1
    gaps = []
    for weight in (0.0, 0.5):
        live = session(
            tmp_path / str(weight),
            config(
                loss={"conservative": weight}, schedule={"offline_updates": 250, "env_steps": 0}
            ),
            logs=shelf,
        )
        train(live)
        live.close()
        q = live.learner.network(cells).detach()
        gaps.append(float((q[:, 1] - q[:, [0, 2]].amax(dim=1)).min()))
    assert gaps[1] > max(gaps[0], 0) + 0.2
    assert q.argmax(dim=1).tolist() == [1] * (CELLS - 1)


def test_margin_drivers_are_listed_once(tmp_path: Path) -> None:
    shelf = logs()
    nobody = Coded(np.zeros(len(shelf), np.int32), ["unknown", "unknown"])  # as in a profile
    shelf = dataclasses.replace(shelf, behaviour_policy=nobody)
    margin = config(loss={"margin": 1.0})
    with pytest.raises(ConfigError, match=r"choose from what they have: unknown$"):
        LogTerms.of(margin, shelf, torch.device("cpu"))


def test_invalid_condition_is_rejected_before_training(tmp_path: Path) -> None:
    broken = Condition("wet", "pre", "humidity > 3")
    with pytest.raises(ConfigError, match="condition 'wet'"):
        session(tmp_path / "a", config(), conditions=[broken])


def test_terminating_bump_is_counted(tmp_path: Path) -> None:
    class Backwards:
        """Policy that drives into the wall behind the first cell."""

        name = version = ""

        def act(self, env: Any, observation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return np.full(len(observation), 2), np.ones(len(observation), np.float32)

    live = session(tmp_path / "a", config())
    live.close()
    twin = ToyTwin(3)
    twin.bump_terminates = True
    buffer = EvaluationBuffer(twin, TASK, CONDITIONS, live.ring, None)
    results = buffer.drive(Backwards(), fixed_episodes(["nominal"], 5, 7))
    assert [result.bumps for result in results] == [1] * 5
    assert [result.failure for result in results] == ["bump"] * 5
