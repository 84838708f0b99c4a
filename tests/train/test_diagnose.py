"""Check that `restock diagnose` finds planted symptoms and stays undetermined without evidence."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from restock.cli import main
from restock.errors import RunError
from restock.train.dqn.config import (
    Hard,
    Polyak,
    TargetRule,
    TeacherConfig,
    TrainConfig,
    apply_overrides,
    parse_config,
)
from restock.train.judge.diagnose import confirm, diagnose, swapped
from restock.train.prepare import Prepared
from restock.train.run.run import Run

CONDITIONS = ("nominal", "wheel_slip", "blocked_aisle", "near_collision", "recovery")
SHARES = dict(zip(CONDITIONS, (0.6, 0.15, 0.1, 0.05, 0.1), strict=True))
FEW = dict.fromkeys(("wheel_slip", "near_collision", "recovery"), 30)  # rows held out


def make_run(
    path: Path, *, windows: int = 4, gap: float | Mapping[str, float] = 1.2, lag: float = 0.05,
    driven: float = 200.0,  # return of an episode
    clock: float = 1.0, q_abs_max: float = 10.0, shares: Mapping[str, float] | None = None,
    agreement: Mapping[str, float] | None = None,
    unexplained: Mapping[str, float] | None = None,
    explained: float | Mapping[str, float] | None = 0.8,
    until: int | None = None,  # the window in which the symptoms end
    held_out: Mapping[str, int] | None = None,  # rows of a condition in each evaluation
    lags: Sequence[float] | None = None,  # L of each window, in place of `lag`
    every: int = 500,  # updates of a window
    target: TargetRule = Polyak(),  # noqa: B008  (frozen)
    seed: int = 0,
) -> Run:  # fmt: skip
    """Write a run whose tables contain these symptoms, in the form that training writes."""
    config = msgspec.to_builtins(TrainConfig(target=target, seed=seed))
    run = Run.create(path, {"config": config, "panel": None})
    for window in range(1, windows + 1):
        clocks = {"env_steps": 1000 * window, "gradient_steps": every * window}
        ill = until is None or window <= until
        lag = lags[window - 1] if lags else lag
        for name in CONDITIONS:
            share = (shares or SHARES).get(name, 0.0) if ill else SHARES[name]
            gap_of_condition = gap.get(name, 1.2) if isinstance(gap, Mapping) else gap
            replay_td = 0.2 if share else None
            unseen = 0.2 * (gap_of_condition if ill else 1.2)
            share_of = explained.get(name, 0.8) if isinstance(explained, Mapping) else explained
            append(
                run, "evaluation_buffer", clocks, condition=name, explained=share_of,
                rows=(held_out or {}).get(name, 200), rows_met=round(SHARES[name] * 1000),
                td_abs_mean=unseen, td_online_abs_mean=unseen * (clock if ill else 1.0),
                q_abs_mean=1.0, q_lag=lag if ill else 0.05,
                logs_agreement=(agreement or {}).get(name, 0.8),
                logs_unexplained=(unexplained or {}).get(name, 0.45),
            )  # fmt: skip
            if share:
                fed = {"drawn_rows": round(share * 10_000), "td_abs_mean": replay_td}
                append(run, "conditions", clocks, source="logs", condition=name, **fed)
        ends = {"target_q_lag": lag if ill else 0.05, "q_abs_max": q_abs_max if ill else 10.0}
        append(run, "progress", clocks, updates=500, **ends)
    append(run, "audit", {}, reward=-1.5)
    append(run, "episodes", {}, steps=240, **{"return": -driven})
    run.flush()
    return run


def append(run: Run, table: str, clocks: Mapping[str, int], **values: Any) -> None:
    """Append a row whose other columns are null."""
    run.append(table, [{**dict.fromkeys(run.table(table).schema.names), **clocks, **values}])


@pytest.mark.parametrize(
    ("symptoms", "cause"),
    [
        ({}, "HEALTHY"),
        ({"gap": {"blocked_aisle": 6.0}}, "BUFFER"),
        # A condition missing from replay is a symptom even with few held-out rows.
        ({"gap": {"blocked_aisle": 6.0}, "held_out": {"blocked_aisle": 100}}, "BUFFER"),
        ({"shares": {**SHARES, "blocked_aisle": 0.0}, "held_out": {"blocked_aisle": 30}}, "BUFFER"),
        ({"shares": {n: s for n, s in SHARES.items() if n != "blocked_aisle"}}, "BUFFER"),
        ({"shares": {**SHARES, "blocked_aisle": 0.02}}, "HEALTHY"),
        ({"agreement": {"blocked_aisle": 0.03}}, "BUFFER"),
        ({"unexplained": {"blocked_aisle": 1.2}}, "BUFFER"),
        (
            {"unexplained": dict.fromkeys(CONDITIONS, 1.2)},
            "HEALTHY",
        ),  # a noisy robot
        ({"clock": 8.0}, "TARGET"),
        ({"gap": 7.0}, "TARGET"),
        ({"q_abs_max": 149.0}, "HEALTHY"),
        ({"q_abs_max": 151.0}, "DIVERGENCE"),  # 1.5 / (1 - .99)
        ({"q_abs_max": 32.0, "driven": 11.0}, "HEALTHY"),
        ({"q_abs_max": 34.0, "driven": 11.0}, "DIVERGENCE"),  # three times the return of an episode
        ({"explained": 0.01}, "DIVERGENCE"),
        # Targets of standing robots hardly vary, so their explained share may be far below 0.
        ({"explained": {"nominal": 0.7, "blocked_aisle": -9.0}, "held_out": FEW}, "HEALTHY"),
        ({"explained": {"nominal": 0.1, "blocked_aisle": 0.1}, "held_out": FEW}, "DIVERGENCE"),
        ({"windows": 2, "lag": 0.9}, "UNDETERMINED"),  # too few to agree
        ({"until": 3, "lag": 0.9}, "UNDETERMINED"),  # absent in the last window
        ({"until": 1, "lag": 0.9}, "HEALTHY"),  # a young critic's lag
        # Every target lags while values grow from 0, so a young run is undetermined.
        ({"every": 400, "lags": (0.9, 0.6, 0.4, 0.3)}, "UNDETERMINED"),
        ({"every": 600, "lags": (0.9, 0.6, 0.4, 0.3)}, "TARGET"),
        ({"every": 325, "lag": 0.4, "target": Polyak(tau=0.02)}, "TARGET"),
        ({"every": 325, "gap": 7.0}, "TARGET"),  # a young run excuses only the lag
        ({"every": 1300, "lags": (0.9, 0.6, 0.4, 0.3), "target": Hard(1000)}, "TARGET"),
        # A target that hardly moves is at fault even in a young run, since L does not fall.
        ({"every": 450, "lag": 1.1, "target": Hard(1_000_000)}, "TARGET"),
        ({"every": 450, "lags": (1.2, 1.15, 1.1, 1.0), "target": Polyak(tau=3e-5)}, "TARGET"),
    ],
)
def test_symptoms_give_expected_cause(tmp_path: Path, symptoms: dict[str, Any], cause: str) -> None:
    assert diagnose([make_run(tmp_path / "r", **symptoms)]).cause == cause


def test_cause_needs_majority_of_seeds(tmp_path: Path) -> None:
    slow = [make_run(tmp_path / f"s{n}", lag=0.9, seed=n) for n in range(2)]
    well = [make_run(tmp_path / f"w{n}", seed=n) for n in range(2, 4)]
    assert diagnose([*slow, well[0]]).cause == "TARGET"
    assert diagnose([*slow, *well]).cause == "UNDETERMINED"


def test_unrelated_runs_are_rejected(tmp_path, capsys) -> None:
    run = str(make_run(tmp_path / "r").path)
    same_seed = str(make_run(tmp_path / "s", windows=3).path)
    recipe = str(make_run(tmp_path / "t", target=Hard(1000), seed=1).path)
    cases = {run: "is given twice", same_seed: "is a copy of", recipe: "in config.target"}
    for other, message in cases.items():
        assert main(["diagnose", run, other]) == 2
        assert message in " ".join(capsys.readouterr().err.split())


def test_diagnose_prints_cause_and_confirmation(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_run(tmp_path / "r", gap={"blocked_aisle": 6.0})
    assert main(["diagnose", str(tmp_path / "r")]) == 0
    shown = capsys.readouterr().out
    assert "BUFFER" in shown
    assert "to confirm: train again with more or corrected rows of blocked_aisle" in shown
    assert main(["diagnose", str(tmp_path / "r"), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["cause"], document["confirmation"]) == ("BUFFER", None)
    assert len(document["runs"][0]["windows"]) == 4


def test_undiagnosable_input_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    Run.create(tmp_path / "young", {"config": msgspec.to_builtins(TrainConfig())})
    make_run(tmp_path / "well")
    early = make_run(tmp_path / "early")  # stopped before a batch was audited
    progress = early.table("progress").drop(["q_abs_max"])
    none = pa.nulls(len(progress), pa.float64())
    pq.write_table(progress.append_column("q_abs_max", none), early.path / "progress.parquet")
    for words, message in (
        ([str(tmp_path / "young")], "has no evaluation to diagnose"),
        ([str(early.path)], "has no evaluation to diagnose"),
        ([str(tmp_path)], "is not a run, a panel or a store"),
        ([], "needs a run"),
        (["nowhere"], "nowhere: does not exist"),
        ([".", "--confirm", "run"], "--confirm: applies only to a run"),
        ([str(tmp_path / "well"), "--confirm", str(tmp_path / "c")], "there is nothing to confirm"),
    ):
        assert main(["diagnose", *words]) == 2
        assert message in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "c").exists()


@pytest.mark.parametrize(
    ("rule", "tau"),
    [(Polyak(tau=0.01), 0.04), (Hard(400), 0.02), (Hard(10**6), 0.005), (Polyak(tau=1.0), 0.005)],
)
@pytest.mark.parametrize("cause", ["TARGET", "BOTH"])
def test_target_experiment_changes_target_rule(tmp_path, rule, tau, cause):
    run = make_run(tmp_path / "r", lag=0.9, every=5000, target=rule)
    changed = parse_config(
        apply_overrides(run.document["config"], swapped(run, cause)), where="test"
    )
    assert changed.target == Polyak(tau=tau) != rule
    assert f"{changed.target} in place of {rule}" in diagnose([run]).experiment


def test_confirm_does_not_overwrite_a_run(tmp_path: Path, capsys) -> None:
    run = str(make_run(tmp_path / "r", lag=0.9).path)
    assert main(["diagnose", run, "--confirm", run]) == 2
    shown = capsys.readouterr()
    assert not shown.out  # rejected before the diagnosis
    error = " ".join(shown.err.split())
    assert "already exists give --confirm another directory" in error
    assert "--out" not in error


@pytest.mark.parametrize("source", ["none", "planner"])
def test_confirm_repeats_run_without_operator_teacher(source, tmp_path, monkeypatch):
    """Repeat a config whose resolved `teacher` settings would be rejected as user input."""
    run = make_run(tmp_path / "r", lag=0.9)
    run.document["config"]["teacher"] |= {"source": source, "successes": False, "ratio": 0.2}
    run.document["panel"] = None
    taught: list[TeacherConfig] = []

    def stop(prepared: Prepared) -> None:
        taught.append(prepared.config.teacher)
        raise RunError("prepared")

    monkeypatch.setattr(Prepared, "open", stop)
    with pytest.raises(RunError, match="prepared"):
        confirm(run, diagnose([run]), tmp_path / "c")
    assert (taught[0].source, taught[0].ratio) == (source, TeacherConfig().ratio)


@pytest.mark.parametrize(
    ("after", "cause", "confirmed"),
    [
        ({"lag": 0.9}, "TARGET", False),  # the target is at fault under another rule too
        ({"gap": {"blocked_aisle": 6.0}}, "BUFFER", True),  # the other fault remains
        ({"windows": 2}, "UNDETERMINED", None),
    ],
)
def test_confirm_of_two_faults_tests_the_target(tmp_path, monkeypatch, after, cause, confirmed):
    run = make_run(tmp_path / "r", lag=0.9, gap={"blocked_aisle": 6.0})
    found = diagnose([run])
    assert found.cause == "BOTH"

    class Trained:
        def __init__(self, out: Path, *_: Any) -> None:
            make_run(out, **after)

        def open(self) -> "Trained":
            return self

        def close(self) -> None: ...

    monkeypatch.setattr("restock.train.judge.diagnose.prepare_new", Trained)
    monkeypatch.setattr("restock.train.judge.diagnose.train", lambda session: None)
    answer = confirm(run, found, tmp_path / "c")
    assert (answer["cause"], answer["confirmed"]) == (cause, confirmed)


@pytest.mark.parametrize("cause", ["BUFFER", "TARGET", "DIVERGENCE"])
def test_experiment_changes_only_the_suspect(tmp_path: Path, cause: Any) -> None:
    run = make_run(tmp_path / "r")
    config = run.document["config"]
    changed = parse_config(apply_overrides(config, swapped(run, cause)), where="test")
    sections = {"BUFFER": {"replay", "env"}, "TARGET": {"target"}, "DIVERGENCE": {"optimizer"}}
    before, after = config, msgspec.to_builtins(changed)
    changes = {key for key in before if before[key] != after[key]}
    assert changes
    assert changes <= sections[cause]
