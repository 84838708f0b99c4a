"""The training loop on a corridor: it learns, repeats itself, and resumes bit for bit."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from support.long import one_in
from support.toy_run import SMALL, assert_same_run, config, logs, run_to_end, session
from support.toy_twin import CELLS, CONDITIONS, TASK, ToyTwin

from restock.cli.learning.train import no_update
from restock.errors import ConfigError, RunError
from restock.ingest.task.conditions import Condition
from restock.train.dqn.learner import Learner
from restock.train.evaluation.evaluate import EpisodeResult, EvaluationBuffer, fixed_episodes
from restock.train.evaluation.policies import GreedyPolicy, load_agent
from restock.train.feed.batches import LogTerms
from restock.train.feed.logs import Coded, Logs
from restock.train.loop import TrainingInterrupted, nothing_to_do, train
from restock.train.run import checkpoint
from restock.train.run.checkpoint import earlier, go_back
from restock.train.run.run import Run
from restock.train.session import Session


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Session:
    return run_to_end(tmp_path_factory.mktemp("runs") / "undisturbed", config())


@pytest.mark.long
def test_the_corridor_is_solved_online_without_logs(tmp_path: Path) -> None:
    live = run_to_end(tmp_path / "a", config(schedule={"env_steps": 6000}), logs=None)
    assert live.best is not None
    assert live.best.success == {"nominal": 1.0, "wheel_slip": 1.0}
    # Forward is the best action of every cell, and the value of the last cell before the goal 1.
    cells = np.zeros((CELLS - 1, TASK.observation_size), np.float32)
    cells[np.arange(CELLS - 1), np.arange(CELLS - 1)] = 1
    assert live.learner.greedy(cells).tolist() == [1] * (CELLS - 1)
    assert live.learner.gradient_steps > 1000


@pytest.mark.parametrize("with_logs", [True, False])
def test_run_out_of_time_still_makes_an_interval_of_updates(
    tmp_path: Path, with_logs: bool
) -> None:
    """There is a policy to keep and something to report, however slow the machine."""
    settings = config(schedule={"seconds": 1e-9, "offline_updates": 1000, "env_steps": 6000})
    live = run_to_end(tmp_path / "a", settings, **({} if with_logs else {"logs": None}))
    least = settings.record.every_updates
    assert least <= live.learner.gradient_steps <= least + 20
    assert live.best is not None
    (row, *_) = [row for row in live.run.table("progress").to_pylist() if row["updates"]]
    assert row["loss"] is not None
    assert (live.progress.env_steps == 0) == with_logs


def test_run_drives_for_half_of_its_time(tmp_path: Path) -> None:
    """Else a robot of few logs and a slow twin ends with a policy that never drove in it."""
    settings = config(schedule={"seconds": 1.0, "offline_updates": 10**6, "env_steps": 10**6})
    live = run_to_end(tmp_path / "a", settings)
    assert live.progress.driving_from_s is not None
    assert live.progress.env_steps > 0
    assert live.learner.gradient_steps < 10**6
    # The evaluation after it is in the budget too.
    assert live.progress.planned_env_steps < 10**6


@pytest.mark.long  # test_algorithms has the shorter ones
def test_offline_learning_alone_agrees_with_value_iteration(tmp_path: Path) -> None:
    """Rows of a corridor that never slips: Q of the logged actions is known in closed form."""
    shelf = logs(600)
    keep = shelf.condition.codes == shelf.condition.names.index("nominal")
    live = session(
        tmp_path / "a",
        config(schedule={"offline_updates": 3000, "env_steps": 0}),
        logs=one_stratum(shelf, stratum_rows=[np.flatnonzero(keep)], shares=np.ones(1)),
    )
    train(live)
    live.close()
    value = np.zeros(CELLS)  # of the state; the last cell is terminal
    for cell in range(CELLS - 2, -1, -1):
        value[cell] = 1.0 if cell == CELLS - 2 else -0.05 + 0.9 * value[cell + 1]
    cells = torch.zeros(CELLS - 1, TASK.observation_size)
    cells[torch.arange(CELLS - 1), torch.arange(CELLS - 1)] = 1
    q = live.learner.network(cells).detach().numpy()
    back = np.array([-0.05 + 0.9 * value[max(cell - 1, 0)] for cell in range(CELLS - 1)])
    stop = -0.05 + 0.9 * value[: CELLS - 1]
    np.testing.assert_allclose(q, np.stack([stop, value[: CELLS - 1], back], axis=1), atol=0.04)


def one_stratum(shelf: Logs, **changes: Any) -> Logs:
    """Return the same logs with one stratum of other rows."""
    return dataclasses.replace(shelf, strata=["nominal"], timings=["pre"], **changes)


def test_the_same_seed_gives_the_same_run(undisturbed: Session, tmp_path: Path) -> None:
    assert_same_run(undisturbed, run_to_end(tmp_path / "again", config()))


def test_simulating_on_another_thread_changes_nothing(undisturbed: Session, tmp_path: Path) -> None:
    assert_same_run(undisturbed, run_to_end(tmp_path / "alone", config(env={"overlap": False})))


@pytest.mark.parametrize("calls", one_in(4, [20, 61, 150, 333]))
def test_interrupted_and_resumed_is_bit_exact(
    undisturbed: Session, tmp_path: Path, calls: int
) -> None:
    requested = iter(range(calls))
    path = tmp_path / "a"
    live = session(path, config())
    with pytest.raises(TrainingInterrupted, match="restock train --resume"):
        train(live, stop=lambda: next(requested, None) is None)
    live.close()

    again = session(path, config(), resume=True)
    train(again)
    again.close()
    assert_same_run(undisturbed, again)


@pytest.mark.parametrize("evaluation", one_in(3, [2, 1, 3]))
def test_an_evaluation_is_abandoned_and_made_by_the_resumed_run(
    undisturbed: Session, tmp_path: Path, evaluation: int
) -> None:
    """After the logs, among online updates, and at the end."""
    path = tmp_path / "a"
    live = session(path, config())
    steps = iter(range(4))
    begun, drive = [], live.evaluation_buffer.drive

    def driving(*args: Any, **kwargs: Any) -> list[EpisodeResult]:
        begun.append(live.progress.env_steps)
        return drive(*args, **kwargs)

    live.evaluation_buffer.drive = driving  # type: ignore[method-assign]
    with pytest.raises(TrainingInterrupted):
        train(live, stop=lambda: len(begun) == evaluation and next(steps, None) is None)
    live.close()
    assert len(begun) == evaluation
    assert live.progress.env_steps == begun[-1] == [0, 800, 1600][evaluation - 1]
    evaluated = pq.read_table(path / "evaluations.parquet")["env_steps"].unique().to_pylist()
    assert evaluated == begun[:-1]

    again = session(path, config(), resume=True)
    train(again)
    again.close()
    assert_same_run(undisturbed, again)


def test_killed_after_a_checkpoint_and_resumed_is_bit_exact(
    undisturbed: Session, tmp_path: Path
) -> None:
    class Killed(Exception):
        pass

    path = tmp_path / "a"
    live = session(path, config())
    rows = iter(range(6))

    def kill(event: str, values: dict[str, Any]) -> None:
        if event == "progress" and next(rows, None) is None:
            raise Killed

    with pytest.raises(Killed):
        train(live, notify=kill)
    live.close()
    assert 0 < checkpoint.load(live.run.latest)["progress"]["env_steps"] < live.progress.env_steps
    again = session(path, config(), resume=True)
    train(again)
    again.close()
    assert_same_run(undisturbed, again)


@pytest.mark.long
def test_an_earlier_checkpoint_leads_to_the_same_end(undisturbed: Session, tmp_path: Path) -> None:
    path = tmp_path / "run"
    live = run_to_end(path, config())
    kept = earlier(live.run.latest)
    steps = live.config.record.checkpoint_every_env_steps
    end = live.progress.env_steps
    assert list(kept) == [(end - 1) // steps * steps - steps, (end - 1) // steps * steps]
    with pytest.raises(RunError, match="no earlier checkpoint was taken after 7 env"):
        go_back(live.run.latest, 7)
    live.run.latest.write_bytes(b"half a file")
    with pytest.raises(RunError, match=f"use an earlier one: --from-env-steps {max(kept)}"):
        session(path, config(), resume=True)
    go_back(live.run.latest, min(kept))
    assert earlier(live.run.latest) == {}
    again = session(path, config(), resume=True)
    assert again.progress.env_steps == min(kept)
    train(again)
    again.close()
    assert_same_run(undisturbed, again)


def test_a_run_is_not_resumed_on_other_logged_rows(tmp_path: Path) -> None:
    settings = config(schedule={"env_steps": 400})
    first = run_to_end(tmp_path / "run", settings)
    probe = pq.read_table(first.run.path / "probe.parquet")["probe_hash"].unique().to_pylist()
    other = dataclasses.replace(logs(), rows=logs().rows.flip(0))
    with pytest.raises(RunError, match=rf"other logged rows: its probe is {probe[0]}") as refused:
        session(first.run.path, settings, logs=other, resume=True)
    assert "the panel that the run began with" in str(refused.value)


@pytest.mark.parametrize("damage", ["missing", "cut"])
def test_run_without_its_kept_policy_is_refused(
    undisturbed: Session, tmp_path: Path, damage: str
) -> None:
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


def test_half_of_each_online_batch_is_from_logs_by_quota(undisturbed: Session) -> None:
    strata = pq.read_table(undisturbed.run.path / "strata.parquet").to_pylist()
    offline = [row for row in strata if row["phase"] == "offline"]
    assert {row["source"] for row in offline} == {"logs"}
    online = [row for row in strata if row["phase"] == "online"]
    for clock in {row["gradient_steps"] for row in online}:
        here = [row for row in online if row["gradient_steps"] == clock]
        drawn = {
            source: sum(row["drawn_rows"] for row in here if row["source"] == source)
            for source in ("logs", "fresh")
        }
        assert drawn["logs"] == drawn["fresh"] > 0
        slip = next(r for r in here if r["source"] == "logs" and r["stratum"] == "wheel_slip")
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


def test_the_critic_is_measured_on_steps_that_no_replay_has(undisturbed: Session) -> None:
    path = undisturbed.run.path
    evaluated = set(pq.read_table(path / "evaluations.parquet")["gradient_steps"].to_pylist())
    measured = pq.read_table(path / "evaluation_buffer.parquet").to_pylist()
    assert {row["gradient_steps"] for row in measured} == evaluated
    assert {row["condition"] for row in measured} >= {"nominal", "wheel_slip"}
    last = [row for row in measured if row["gradient_steps"] == max(evaluated)]
    first = [row for row in measured if row["gradient_steps"] == min(evaluated)]
    assert all(row["rows"] > 0 and row["td_abs_mean"] > 0 for row in measured)
    mean = [sum(row["td_abs_mean"] for row in rows) / len(rows) for rows in (first, last)]
    assert mean[1] < mean[0]  # it learnt


def test_evaluation_does_not_depend_on_what_drove_before(tmp_path: Path) -> None:
    live = session(tmp_path / "a", config())
    policy = GreedyPolicy(live.learner.policy_network)
    specs = fixed_episodes(["nominal", "wheel_slip"], 4, 7)  # 8 episodes in 3 corridors

    def measured() -> tuple[int, list[dict[str, Any]]]:
        driven = live.evaluation_buffer.drive(policy, specs)
        steps = round(sum(result.time_s for result in driven) / TASK.control_period_s)
        return steps, live.evaluation_buffer.measure(live.learner)

    steps, first = measured()
    assert measured() == (steps, first)
    # Of the steps that environments drive on, once their episodes are done, none is counted.
    assert sum(row["rows_met"] for row in first) == steps
    live.close()


def test_audit_rows_hold_what_the_row_was(undisturbed: Session) -> None:
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
            assert row["age_gradient_steps"] == row["gradient_step"]  # since it could be drawn
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
    # Only a forward command can slip, and a slipping robot is where it was.
    assert len(slip_rows)
    assert set(slip_rows[:, -3].tolist()) == {1.0}


def test_the_run_says_its_target_rule_and_lag(undisturbed: Session, tmp_path: Path) -> None:
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
    # Every interval ends on a sync, where the distance is 0: what is logged is from just before.
    assert {row["target_sampled"] for row in full} == {"before_sync"}
    assert all(row["target_param_distance"] > 0 and row["target_q_lag"] > 0 for row in full)
    assert {row["steps_since_sync"] for row in full} == {0}


def test_the_best_checkpoint_is_by_evaluation_not_the_last(undisturbed: Session) -> None:
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


def test_warmup_collects_without_learning(
    tmp_path: Path,
) -> None:
    settings = config(schedule={"env_steps": 400, "warmup_env_steps": 400})
    live = session(tmp_path / "a", settings, logs=None)
    said = no_update(train(live), settings)
    live.close()
    assert live.learner.gradient_steps == 0
    assert len(live.ring) > 300
    assert said is not None
    assert said.startswith("no update was made in 400 environment steps")
    assert "schedule.warmup_env_steps=400" in said


def test_a_run_whose_updates_were_all_on_the_logs_says_so(tmp_path: Path) -> None:
    settings = config(schedule={"env_steps": 40, "warmup_env_steps": 400, "offline_updates": 5})
    live = session(tmp_path / "a", settings, logs=logs())
    outcome = train(live)
    live.close()
    assert outcome.gradient_steps == 5
    said = no_update(outcome, settings)
    assert said is not None
    assert said.startswith("no update was made in 40 environment steps, so the policy is that of")
    assert no_update(dataclasses.replace(outcome, env_steps=0), settings) is None


def test_updates_in_the_twin_are_counted_apart(tmp_path: Path) -> None:
    settings = config(schedule={"env_steps": 600, "offline_updates": 10_000})
    live = session(tmp_path / "a", settings, logs=None)
    outcome = train(live)
    live.close()
    assert 0 < outcome.online_updates == outcome.gradient_steps < 10_000
    assert no_update(outcome, settings) is None


def test_resumed_run_says_that_its_budget_is_used_up(undisturbed: Session, tmp_path: Path) -> None:
    path = Path(shutil.copytree(undisturbed.run.path, tmp_path / "run"))

    def said(**schedule: Any) -> str:
        live = session(path, config(schedule=schedule), resume=True)
        live.close()
        return nothing_to_do(live) or "goes on"

    assert (
        said() == "its budget of 1,600 environment steps is used up; give more with --env-steps N"
    )
    assert said(env_steps=2000) == "goes on"
    used_up = said(env_steps=2000, seconds=1e-9)
    assert used_up == "its budget of 1e-09 s is used up; give more with --seconds S"
    undisturbed.progress.evaluated_at, before = 800, undisturbed.progress.evaluated_at
    assert nothing_to_do(undisturbed) is None  # its last evaluation was abandoned
    undisturbed.progress.evaluated_at = before


def test_a_resume_that_has_nothing_to_do_changes_nothing_on_disk(tmp_path: Path) -> None:
    settings = config(schedule={"env_steps": 1200}, record={"tensorboard": True})
    done = session(tmp_path / "run", settings)
    outcome = train(done)
    done.close()

    def files() -> dict[Path, tuple[int, bytes]]:
        found = (file for file in done.run.path.rglob("*") if file.is_file())
        return {file: (file.stat().st_mtime_ns, file.read_bytes()) for file in found}

    before = files()
    assert any("tensorboard" in file.parts for file in before)
    assert sorted(earlier(done.run.latest)) == [400, 800]
    for _ in range(2):
        again = session(done.run.path, settings, resume=True)
        assert train(again).env_steps == outcome.env_steps == 1200
        again.close()
    assert files() == before


def test_interrupted_resume_keeps_earlier_checkpoints(undisturbed: Session, tmp_path: Path) -> None:
    path = Path(shutil.copytree(undisturbed.run.path, tmp_path / "run"))
    latest = path / "checkpoints" / undisturbed.run.latest.name
    kept = list(earlier(latest))
    assert kept
    for _ in range(3):
        live = session(path, config(schedule={"env_steps": 2400}), resume=True)
        with pytest.raises(TrainingInterrupted):
            train(live, stop=lambda: True)
        live.close()
    assert list(earlier(latest)) == kept


def test_updates_keep_the_asked_ratio(undisturbed: Session) -> None:
    progress = undisturbed.progress
    assert progress.online_from == 200
    assert progress.online_updates == int((progress.env_steps - 200) * 0.25)
    assert undisturbed.learner.gradient_steps == 60 + progress.online_updates


def test_a_learner_fits_a_batch_it_sees_again_and_again() -> None:
    learner = Learner(config(), TASK.observation_size, 3)
    rows = logs().rows[:32].clone()
    rows[:, -1] = 0  # terminal: the target is the reward
    for _ in range(400):
        loss = learner.update(rows)
    assert float(loss.td.abs().max()) < 0.9
    expected = rows[:, -2]
    td, q, _ = learner.td_error(rows)
    chosen = q.gather(1, rows[:, -3:-2].long()).squeeze(1)
    assert torch.allclose(td, chosen - expected, atol=1e-5)


def test_the_policy_that_is_kept_is_an_average_of_the_weights() -> None:
    rows = logs().rows[:32].clone()
    for rate in (1.0, 0.25):
        learner = Learner(config(evaluation={"averaging": rate}), TASK.observation_size, 3)
        seen = []
        for _ in range(6):
            learner.update(rows)
            seen.append(learner.network.advantage.bias.detach().clone())
        # The mean of the first four, then a quarter of the way to each further one.
        expected = seen[-1]
        if rate == 0.25:
            expected = torch.stack(seen[:4]).mean(dim=0)
            for weights in seen[4:]:
                expected = expected + 0.25 * (weights - expected)
        assert torch.allclose(learner.policy_network.advantage.bias, expected, atol=1e-6)


def test_the_conservative_term_lowers_what_the_logs_never_did(tmp_path: Path) -> None:
    """Offline on rows that only drive forward: without it, "back" is worth what chance says."""
    shelf = logs(400)
    forward = np.flatnonzero(shelf.rows[:, -3].numpy() == 1)
    shelf = one_stratum(shelf, stratum_rows=[forward], shares=np.ones(1))
    cells = torch.zeros(CELLS - 1, TASK.observation_size)
    cells[torch.arange(CELLS - 1), torch.arange(CELLS - 1)] = 1
    gaps = []
    for weight in (0.0, 0.5):
        live = session(
            tmp_path / str(weight),
            config(
                loss={"conservative": weight}, schedule={"offline_updates": 600, "env_steps": 0}
            ),
            logs=shelf,
        )
        train(live)
        live.close()
        q = live.learner.network(cells).detach()
        gaps.append(float((q[:, 1] - q[:, [0, 2]].amax(dim=1)).min()))
    assert gaps[1] > max(gaps[0], 0) + 0.2
    assert q.argmax(dim=1).tolist() == [1] * (CELLS - 1)


def spoilt(live: Session, at: int) -> Any:
    """Return a `stop` that makes the policy stand still from an environment step on."""

    def stop() -> bool:
        if live.progress.env_steps >= at and not getattr(stop, "done", False):
            stop.done = True  # type: ignore[attr-defined]
            for network in (live.learner.network, live.learner.policy_network):
                with torch.no_grad():
                    network.advantage.weight.zero_()
                    network.advantage.bias.copy_(torch.tensor([50.0, -50.0, -50.0]))
        return False

    return stop


def test_the_margin_is_for_rows_of_the_named_policy() -> None:
    shelf = logs()
    operator = shelf.behaviour_policy.codes == shelf.behaviour_policy.names.index("operator")
    terms = LogTerms.of(config(loss={"margin": 1.0}).loss, shelf, torch.device("cpu"))
    expert = terms.expert_rows(np.arange(len(shelf)))
    assert expert is not None
    np.testing.assert_array_equal(expert.numpy(), operator)


def test_a_margin_for_a_policy_that_the_logs_lack_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="have no 'nobody'"):
        session(tmp_path / "r", config(loss={"margin": 1.0, "margin_policies": ["nobody"]}))


def test_drivers_that_a_margin_may_name_are_listed_once(tmp_path: Path) -> None:
    shelf = logs()
    nobody = Coded(np.zeros(len(shelf), np.int32), ["unknown", "unknown"])  # named so by a profile
    shelf = dataclasses.replace(shelf, behaviour_policy=nobody)
    loss = config(loss={"margin": 1.0}).loss
    with pytest.raises(ConfigError, match=r"choose from what they have: unknown$"):
        LogTerms.of(loss, shelf, torch.device("cpu"))


@pytest.mark.long
def test_a_run_with_every_term_resumes_bit_exactly(tmp_path: Path) -> None:
    settings = config(
        loss={"margin": 0.5, "conservative": 0.1},
        network={"hidden": [16]},
        schedule={**SMALL["schedule"], "env_steps": 800},
    )
    whole = run_to_end(tmp_path / "whole", settings)
    first = session(tmp_path / "cut", settings)
    steps = iter(range(10_000))
    with pytest.raises(TrainingInterrupted):
        train(first, stop=lambda: next(steps) > 150)
    first.close()
    second = session(tmp_path / "cut", settings, resume=True)
    train(second)
    second.close()
    assert_same_run(whole, second)


def test_condition_that_cannot_run_is_refused_first(tmp_path: Path) -> None:
    broken = Condition("wet", "pre", "humidity > 3")
    with pytest.raises(ConfigError, match="condition 'wet'"):
        session(tmp_path / "a", config(), conditions=[broken])


def test_a_bump_that_ends_an_evaluations_episode_is_counted(tmp_path: Path) -> None:
    class Backwards:
        """Into the wall behind the first cell."""

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
