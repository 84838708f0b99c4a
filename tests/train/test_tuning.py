"""`restock train` of a space: what is drawn, what is stopped, and how it goes on after a cut."""

from __future__ import annotations

import json
import os
import signal
import tomllib
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from restock import cli
from restock.errors import ConfigError, RunError
from restock.stats import wilson
from restock.train.dqn.config import parse_config
from restock.train.study import tuning
from restock.train.study.space import Search, load_search, settings_of, trial_name
from restock.train.study.study_run import train_words
from restock.train.study.tuning import SearchPlan, run_search, worst_condition

TEXT = """
doc = "which step size?"
seeds = [0, 1]
trials = 6
startup_trials = 3
[settings]
schedule.env_steps = 400
[evaluation]
episodes = 20
[space]
"loss.n_step" = { low = 1, high = 5 }
optimizer.learning_rate = { low = 1e-4, high = 1e-2, log = true }
network.hidden = { choices = [[16], [32, 32]] }
"""


def plan_of(folder: Path, text: str = TEXT) -> SearchPlan:
    file = folder / "search.toml"
    file.write_text(text)
    return SearchPlan(load_search(file), folder, folder / "out")


def episodes(**successes: tuple[int, int]) -> pa.Table:
    rows = [
        {"condition": condition, "success": index < observed}
        for condition, (observed, count) in successes.items()
        for index in range(count)
    ]
    return pa.Table.from_pylist(rows)


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, ...]]:
    """Runs that cost nothing: the larger the step size, the better in the one rare condition."""
    pytest.importorskip("optuna", reason="optuna is not installed: restock[tune]")
    requested: list[tuple[str, ...]] = []

    def train(path: Path, settings: list[str], *_: Any) -> bool:
        requested.append(tuple(settings))
        path.mkdir(parents=True)
        (path / "settings").write_text("\n".join(settings))
        return True

    def evaluated(run: Path) -> pa.Table:
        rate = float((run / "settings").read_text().split("learning_rate=")[1].split("\n")[0])
        return episodes(nominal=(20, 20), wheel_slip=(min(int(rate * 2000), 20), 20))

    monkeypatch.setattr(tuning, "_train", train)
    monkeypatch.setattr(tuning, "restock_verb", lambda words, log: None)
    monkeypatch.setattr(tuning.Run, "open", lambda path: path)
    monkeypatch.setattr(tuning, "agent_episodes", evaluated)
    return requested


def test_the_objective_is_the_worst_conditions_lower_bound_over_all_seeds() -> None:
    tables = [episodes(nominal=(9, 10), wheel_slip=(10, 10)), episodes(nominal=(8, 10))]
    assert worst_condition(tables) == (wilson(17, 20)[0], "nominal")
    # Ten of ten say less than 39 of 40.
    assert worst_condition([episodes(a=(39, 40), b=(10, 10))])[1] == "b"
    with pytest.raises(RunError, match="no goal"):
        worst_condition([pa.table({"condition": ["nominal"], "success": pa.nulls(1, pa.bool_())})])


def test_a_search_trains_every_seed_and_keeps_the_best(
    tmp_path: Path, trained: list[tuple[str, ...]]
) -> None:
    plan = plan_of(tmp_path)
    found = run_search(plan)
    assert len(found["trials"]) == 6
    assert len(trained) == 12
    assert {settings[-1] for settings in trained} == {"seed=0", "seed=1"}
    assert all("schedule.env_steps=400" in settings for settings in trained)
    best = max(found["trials"], key=lambda trial: trial["worst_lower_bound"])
    assert found["best"]["worst_lower_bound"] == best["worst_lower_bound"]
    config = parse_config(tomllib.loads((plan.out / "best.toml").read_text()), where="best.toml")
    assert config.optimizer.learning_rate == found["best"]["values"]["optimizer.learning_rate"]
    assert list(config.network.hidden) in ([16], [32, 32])
    assert 1 <= config.loss.n_step <= 5


def test_an_interrupted_search_draws_what_it_would_have(
    tmp_path: Path, trained: list[tuple[str, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "whole").mkdir()
    whole = run_search(plan_of(tmp_path / "whole"))
    (tmp_path / "cut").mkdir()
    plan, once = plan_of(tmp_path / "cut"), tuning._train

    def cut(path: Path, settings: list[str], *others: Any) -> bool:
        if len(list(plan.out.glob("runs/*"))) == 5:  # within the third trial
            raise KeyboardInterrupt
        return once(path, settings, *others)

    monkeypatch.setattr(tuning, "_train", cut)
    with pytest.raises(KeyboardInterrupt):
        run_search(plan)
    monkeypatch.setattr(tuning, "_train", once)
    trained.clear()
    again = run_search(plan)
    assert [t["values"] for t in again["trials"]] == [t["values"] for t in whole["trials"]]
    assert len(trained) == 12 - 5  # what was trained is not trained again
    # More trials may be asked for; another space is another search.
    more = plan_of(tmp_path / "cut", TEXT.replace("trials = 6", "trials = 7"))
    assert len(run_search(more)["trials"]) == 7
    with pytest.raises(RunError, match="another search"):
        run_search(plan_of(tmp_path / "cut", TEXT.replace("high = 5", "high = 4")))


def test_a_run_goes_on_from_its_checkpoint_or_begins_again(tmp_path: Path) -> None:
    run, panel = tmp_path / "run", tmp_path / "panel"
    begin = ["train", "--out", str(run), "--set", "seed=1", "--panel", str(panel)]
    assert train_words(run, ["seed=1"], panel) == begin
    run.mkdir()
    (run / "config.json").touch()  # cut before its first checkpoint
    assert train_words(run, ["seed=1"], panel) == begin
    assert not run.exists()
    (run / "checkpoints").mkdir(parents=True)
    (run / "checkpoints" / "latest.safetensors").touch()
    assert train_words(run, ["seed=1"], panel) == ["train", "--resume", str(run)]


def test_mixtures_of_one_name_in_two_folders_have_panels_of_their_own(tmp_path: Path) -> None:
    space = "mixture = { choices = ['coverage', 'a/coverage.toml', 'b/coverage.toml'] }"
    plan = plan_of(tmp_path, f"store = 'store'\n[space]\n{space}\n")
    names = plan.search.parameters["mixture"].choices
    panels = [plan.panel({"mixture": name}) for name in names]
    assert panels[0] == plan.out / "panels" / "coverage"
    assert len(set(panels)) == 3
    assert {panel.parent for panel in panels if panel is not None} == {plan.out / "panels"}


@pytest.mark.parametrize("ended_by", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_what_ends_the_search_reaches_the_training_once(
    ended_by: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C, a kill, or a terminal that is closed: nothing trains on alone."""
    signals: list[int] = []

    class Process:
        def __init__(self, words: list[str], *, start_new_session: bool, **_: Any) -> None:
            assert start_new_session  # else the terminal sends it another: "end at once"

        def poll(self) -> None:
            os.kill(os.getpid(), ended_by)

        def send_signal(self, number: int) -> None:
            signals.append(number)

        def wait(self) -> int:
            return 130

    monkeypatch.setattr(tuning.subprocess, "Popen", Process)
    usual = signal.default_int_handler if ended_by == signal.SIGINT else signal.SIG_DFL
    before = signal.signal(ended_by, usual)
    try:
        with pytest.raises(KeyboardInterrupt):
            tuning._train(tmp_path / "run", [], None, tmp_path / "log", None, 0)
        assert signal.getsignal(ended_by) == usual
    finally:
        signal.signal(ended_by, before)
    assert signals == [signal.SIGTERM]


def test_a_trial_is_told_of_the_evaluations_of_its_training(tmp_path: Path) -> None:
    class Trial:
        def __init__(self) -> None:
            self.reports: list[tuple[float, int]] = []

        def report(self, value: float, step: int) -> None:
            self.reports.append((value, step))

        def should_prune(self) -> bool:
            return self.reports[-1][0] < 0.2

    trial, reported = Trial(), set[int]()
    assert not tuning._falls_behind(trial, tmp_path, reported, 0)  # nothing is evaluated yet
    rows = [
        {"env_steps": steps, "condition": "nominal", "success": index < observed}
        for steps, observed in ((0, 9), (200, 2))
        for index in range(10)
    ]
    pq.write_table(pa.Table.from_pylist(rows[:10]), tmp_path / "evaluations.parquet")
    assert not tuning._falls_behind(trial, tmp_path, reported, 0)
    assert not tuning._falls_behind(trial, tmp_path, reported, 0)
    pq.write_table(pa.Table.from_pylist(rows), tmp_path / "evaluations.parquet")
    assert tuning._falls_behind(trial, tmp_path, reported, 0)
    assert trial.reports == [(wilson(9, 10)[0], 0), (wilson(2, 10)[0], 200)]


@pytest.mark.parametrize(
    ("space", "said"),
    [
        ("'loss.n_step' = { low = 5, high = 1 }", "low must be below high"),
        ("'loss.n_step' = { low = 0, high = 4 }", r"`space.loss.n_step` = 0"),
        ("'loss.nstep' = { low = 1, high = 4 }", "unknown key"),
        ("'loss.n_step' = 3", "must be a table"),
        ("'loss.discount' = { low = 0.0, high = 0.9, log = true }", "low above 0"),
        ("seed = { low = 0, high = 9 }", "must not set seed"),
        ("mixture = { choices = ['uniform'] }", "without a store"),
    ],
)
def test_a_space_that_cannot_be_searched_is_refused(tmp_path: Path, space: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        plan_of(tmp_path, f"[space]\n{space}\n")


def test_a_trials_name_is_that_of_its_values() -> None:
    assert trial_name({"a": 1, "b": [2]}) == trial_name({"b": [2], "a": 1}) != trial_name({"a": 2})
    search = Search(space={"loss": {"n_step": {"low": 1, "high": 3}}}, settings={"threads": 2})
    assert settings_of(search, {"loss.n_step": 2, "mixture": "uniform"}) == [
        "threads=2",
        "loss.n_step=2",
    ]


def test_the_space_is_shown_before_anything_is_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan_of(tmp_path)
    words = ["train", str(tmp_path / "search.toml"), "--out", str(tmp_path / "out")]
    assert cli.main([*words, "--dry-run", "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert [row["key"] for row in shown["space"]] == [
        *("loss.n_step", "optimizer.learning_rate", "network.hidden"),
    ]
    assert not (tmp_path / "out").exists()
    assert cli.main([*words, "--workers", "2"]) == 2
    assert "its trials" in capsys.readouterr().err


@pytest.mark.slow
def test_a_search_trains_for_real_and_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("optuna", reason="optuna is not installed: restock[tune]")
    (tmp_path / "s.toml").write_text("""
trials = 2
[settings]
network.hidden = [16]
schedule.env_steps = 400
schedule.warmup_env_steps = 150
evaluation.every_env_steps = 200
evaluation.episodes = 1
[evaluation]
episodes = 1
[space]
"loss.n_step" = { low = 1, high = 5 }
""")
    words = ["train", str(tmp_path / "s.toml"), "--out", str(tmp_path / "out"), "--json"]
    assert cli.main(words) == 0
    first = json.loads(capsys.readouterr().out)
    assert [trial["state"] for trial in first["trials"]] == ["complete"] * 2
    assert all(trial["evaluations"] >= 1 for trial in first["trials"])
    assert cli.main(words) == 0
    assert json.loads(capsys.readouterr().out) == first
