"""Check studies of `restock train`: runs of each arm and seed, comparisons and rejections."""

import json
from pathlib import Path
from signal import SIGINT, pthread_kill
from threading import Event, main_thread
from time import sleep

import pytest
from support.shell import Shell
from support.stores import recording_transitions, write_store

from restock.cli import main
from restock.errors import ConfigError, RunError
from restock.train.judge.comparability import Difference
from restock.train.judge.compare import Comparison
from restock.train.study import study_run
from restock.train.study.study import StudyPlan, load_study

SMALL = """
treatment = "algorithm"
seeds = [0]
[settings]
network.hidden = [16]
schedule.env_steps = 400
schedule.warmup_env_steps = 150
schedule.updates_per_env_step = 0.1
evaluation.every_env_steps = 400
evaluation.episodes = 1
record.trackers = []
[evaluation]
episodes = 1
[[arms]]
name = "plain"
[[arms]]
name = "dueling"
settings = { network.layer_norm = false }
"""

TWICE = f"""measures = []{SMALL}
[[arms]]
name = "again"
baseline = "dueling"
treatment = "method"
"""
TWO = "[[arms]]\nname = 'a'\n[[arms]]\nname = 'b'\n"
PRIMARY = "primary = { arm = 'b', measure = 'auc_rare' }"


@pytest.fixture(autouse=True)
def no_references(monkeypatch: pytest.MonkeyPatch) -> None:
    """Skip the reference drives of planner and operator."""
    monkeypatch.setattr(study_run, "_drive_references", lambda plan, say: None)


@pytest.mark.slow
def test_study_runs_each_arm_once_and_compares(tmp_path: Path, capsys, shell: Shell) -> None:
    (tmp_path / "s.toml").write_text(SMALL)
    out = tmp_path / "out"
    argv = ["train", str(tmp_path / "s.toml"), "--out", str(out), "--workers", "2", "--json"]
    # The run has too few episodes, so the comparison is refused.
    found = json.loads(shell.out(*argv, code=1))
    (comparison,) = found["comparisons"]
    assert (comparison["arm"], comparison["baseline"]) == ("dueling", "plain")
    assert comparison["verdict"] in ("inconclusive", "incomparable")
    assert [d["setting"] for d in comparison["differences"]] == ["config.network.layer_norm"]
    assert "Gate refused" in (out / "study.md").read_text()
    made = {path: path.stat().st_mtime_ns for path in out.glob("runs/*/*.parquet")}
    assert len({path.parent.name for path in made}) == 2
    main(argv)
    assert "2 of 2 runs already exist" in capsys.readouterr().err
    assert {path: path.stat().st_mtime_ns for path in made} == made
    # Other settings in the same directory are rejected.
    (tmp_path / "s.toml").write_text(SMALL.replace("400", "500", 1))
    assert "was trained with other settings" in shell.err(*argv)


@pytest.mark.long
def test_failed_run_names_its_log_file(tmp_path: Path, shell: Shell) -> None:
    text = SMALL.replace("[settings]", "[settings]\nenv.layouts = 'nowhere.toml'")
    (tmp_path / "s.toml").write_text(text)
    error = " ".join(shell.err("train", tmp_path / "s.toml", "--out", tmp_path / "o").split())
    assert "plain-0.log: `restock train` failed with exit code 2" in error
    assert "nowhere.toml" in error


def test_dry_run_lists_the_runs(tmp_path: Path, shell: Shell) -> None:
    (tmp_path / "s.toml").write_text(SMALL.replace("[0]", "[0, 7]"))
    argv = ["train", str(tmp_path / "s.toml"), "--out", str(tmp_path / "o"), "--dry-run", "--json"]
    rows = json.loads(shell.out(*argv))
    assert [Path(row["run"]).name for row in rows] == [
        *("plain-0", "dueling-0"),
        *("plain-7", "dueling-7"),
    ]
    assert "network.layer_norm=false" in rows[1]["settings"]
    assert not (tmp_path / "o").exists()


def test_arm_may_set_baseline_and_treatment(tmp_path: Path, shell: Shell) -> None:
    # Compare coverage with uniform as mixtures, and a margin on one mixture as an algorithm.
    (tmp_path / "s.toml").write_text("""
treatment = "mixture"
seeds = [0]
[[arms]]
name = "uniform"
[[arms]]
name = "margin"
treatment = "algorithm"
baseline = "coverage"
[[arms]]
name = "coverage"
[[arms]]
name = "method"
treatment = "method"
""")
    argv = ["train", str(tmp_path / "s.toml"), "--out", str(tmp_path / "o"), "--dry-run", "--json"]
    assert [row["against"] for row in json.loads(shell.out(*argv))] == [
        *(None, "coverage (algorithm)"),
        *("uniform (mixture)", "uniform (method)"),
    ]


def make_finished_runs(tmp_path: Path, text: str) -> Path:
    """Write s.toml; return its output folder, in which every run is marked as finished."""
    (tmp_path / "s.toml").write_text(text)
    plan = StudyPlan(load_study(tmp_path / "s.toml"), tmp_path, tmp_path / "out")
    for job in plan.jobs:
        job.path.mkdir(parents=True)
        job.done.write_text(plan.fingerprint(job))
    return tmp_path / "out"


def test_changed_study_reports_differences(tmp_path: Path, shell: Shell) -> None:
    study = tmp_path / "s.toml"
    arms = "[[arms]]\nname = 'a'\nmixture = 'uniform'\n[[arms]]\nname = 'b'\npanel = 'p'\n"
    text = f"store = 's'\nseeds = [0]\nsettings.loss.n_step = 1\n{arms}"
    moved = make_finished_runs(tmp_path, text).rename(tmp_path / "moved")
    line = ["train", str(study), "--out", str(moved), "--dry-run", "--json"]
    assert all(row["done"] for row in json.loads(shell.out(*line)))
    study.write_text(text.replace("n_step = 1", "n_step = 3"))
    error = " ".join(shell.err(*line).split())
    assert "then loss.n_step=1, now loss.n_step=3" in error
    study.write_text(text.replace("'p'", "'q'"))
    assert 'then panel = "p", now panel = "q"' in " ".join(shell.err(*line).split())


def test_comparisons_use_treatment_of_their_arm(tmp_path: Path, capsys, monkeypatch) -> None:
    out = make_finished_runs(tmp_path, TWICE)
    dueling = Difference("config.network.layer_norm", "algorithm", True, False)

    def compared(first, second, *, treatment):
        requested.append((first[0].name, second[0].name, treatment))
        if treatment == "algorithm":
            return Comparison(treatment, "incomparable", [dueling], [dueling], [], [], None, [])
        return Comparison(treatment, "comparable", [dueling], [], [], [], "evaluation", [])

    requested: list[tuple[str, str, str]] = []
    monkeypatch.setattr(study_run, "compare", compared)
    assert main(["train", str(tmp_path / "s.toml"), "--out", str(out), "--json"]) == 1
    assert requested == [("plain-0", "dueling-0", "algorithm"), ("dueling-0", "again-0", "method")]
    first, second = json.loads(capsys.readouterr().out)["comparisons"]
    keys = ("arm", "baseline", "treatment")
    assert [first[key] for key in keys] == ["dueling", "plain", "algorithm"]
    assert [second[key] for key in keys] == ["again", "dueling", "method"]
    page = (out / "study.md").read_text()
    assert "differ in config.network.layer_norm, which treatment algorithm does not" in page
    assert "## again against dueling" in page
    assert "Not held: the algorithm (network.layer_norm)." in page


def test_failed_comparison_does_not_stop_study(tmp_path: Path, monkeypatch, shell: Shell) -> None:
    out = make_finished_runs(tmp_path, TWICE)

    def compared(first, second, *, treatment):
        if treatment == "algorithm":
            raise RunError("has no record of the episodes it sampled", where=str(second[0]))
        return Comparison(treatment, "comparable", [], [], [], [], "evaluation", [])

    monkeypatch.setattr(study_run, "compare", compared)
    first, second = shell.json("train", tmp_path / "s.toml", "--out", out, code=1)["comparisons"]
    assert (first["verdict"], second["verdict"]) == ("inconclusive", "comparable")
    why = "runs/dueling-0: has no record of the episodes it sampled"
    assert why in first["why"]
    assert f"{why}." in (out / "study.md").read_text()
    assert why in (out / "study.html").read_text()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ("schedule.env_steps = 1_500", "'a' would make no update: its schedule.env_steps (1,500)"),
        ("schedule.env_steps = 2_000", "and it has no logs"),
    ],
)
def test_arm_without_updates_is_rejected(tmp_path, settings, message) -> None:
    study = f"store = 's'\n[settings]\n{settings}\n"
    (tmp_path / "s.toml").write_text(study + TWO)
    with pytest.raises(ConfigError) as refused:
        load_study(tmp_path / "s.toml")
    assert message in str(refused.value)
    with_logs = TWO.replace("'\n", "'\nmixture = 'uniform'\n")
    (tmp_path / "s.toml").write_text(study + with_logs)
    assert load_study(tmp_path / "s.toml")
    (tmp_path / "s.toml").write_text(f"{study}schedule.offline_updates = 0\n{with_logs}")
    with pytest.raises(ConfigError, match=r"schedule\.offline_updates is 0"):
        load_study(tmp_path / "s.toml")


@pytest.mark.parametrize("interrupted", [False, True])
def test_no_run_starts_after_a_failure(tmp_path, capsys, monkeypatch, interrupted):
    begun, running, ended = [], Event(), Event()

    def job(plan, job, say):
        begun.append(job.path.name)
        if job.arm.name == "plain":
            assert running.wait(30)
            raise RunError("ran out of disk", where="here")
        running.set()
        for _ in range(3000):  # until the failure is reported
            if "waiting for those under way" in "".join(messages):
                break
            sleep(0.01)
        if interrupted:
            pthread_kill(main_thread().ident, SIGINT)
            assert ended.wait(30)

    messages: list[str] = []
    monkeypatch.setattr("restock.cli.learning.study.say", messages.append)
    monkeypatch.setattr(study_run, "run_job", job)
    monkeypatch.setattr(study_run, "interrupt_running", ended.set)
    (tmp_path / "s.toml").write_text(SMALL.replace("[0]", "[0, 1]"))
    argv = ["train", str(tmp_path / "s.toml"), "--out", str(tmp_path / "out"), "--workers", "2"]
    assert main(argv) == (130 if interrupted else 2)
    assert ended.is_set() is interrupted
    assert sorted(begun) == ["dueling-0", "plain-0"]
    assert "here: ran out of disk" in messages


def test_dry_run_checks_mixtures(tmp_path: Path, shell: Shell) -> None:
    arms = '[[arms]]\nname = "a"\nmixture = "uniform"\n[[arms]]\nname = "b"\nmixture = "b.toml"\n'
    (tmp_path / "s.toml").write_text(f'store = "s"\ntreatment = "mixture"\n{arms}')
    (tmp_path / "b.toml").write_text("where = 'speed > 1'\n[each_condition]\n")
    argv = ["train", str(tmp_path / "s.toml"), "--out", str(tmp_path / "o"), "--dry-run", "--json"]
    assert f"{tmp_path / 's'}: no such store" in shell.err(*argv)
    write_store(tmp_path / "s", [recording_transitions(1)])
    assert f"{tmp_path / 'b.toml'}: mixture, `where`: its SQL" in shell.err(*argv)
    (tmp_path / "b.toml").write_text("where = 'reward > -99'\n[each_condition]\n")
    assert main(argv) == 0
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("arms = []", "arms must be two or more"),
        ('[[arms]]\nname = "a"\nmixture = "u"\n[[arms]]\nname = "b"', "but the study has no store"),
        (f"baseline = 'c'\n{TWO}", "`baseline`"),
        (f"{TWO}baseline = 'c'", "'c' is not one of the arms"),
        (
            '[[arms]]\nname = "a"\ntreatment = "method"\n[[arms]]\nname = "b"',
            "'a' is the first, the study's baseline: it cannot have a treatment",
        ),
        (f"seeds = [1, 1]\n{TWO}", "without repetition"),
        (f"[settings]\nseed = 3\n{TWO}", "must not set seed"),
        (f"{TWO}[evaluation]\nperturbations = []", "perturbations: names nothing"),
        (f"measures = ['auc']\n{TWO}", "measure 'auc' must be auc_WHAT or success_WHAT"),
        (f"seeds = [-1, 1]\n{TWO}", "seeds must be from 0 to 2147483647, got -1"),
        (f"{PRIMARY.replace('b', 'c', 1)}\n{TWO}", "primary: 'c' is not one of the arms"),
        (
            f"primary = {{ arm = 'a', measure = 'auc_rare' }}\n{TWO}",
            "primary: 'a' is not one of the arms after the first",
        ),
        # Seeds from 90000 on select the best policy, so others must evaluate it.
        (
            f"{TWO}[settings]\nevaluation.seed = 10_039",
            "evaluated on seeds 10000 to 10039, which include those that choose",
        ),
    ],
)
def test_invalid_study_is_rejected(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "s.toml").write_text(text)
    with pytest.raises(ConfigError, match=message):
        load_study(tmp_path / "s.toml")
