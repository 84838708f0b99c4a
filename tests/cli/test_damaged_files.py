"""Missing, cut or changed files: every verb names the path and a remedy, and exits 2, never 1."""

import json
import os
import shutil
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.long import one_in
from support.panels import panel_of
from support.stores import recording_transitions, write_store

from restock import cli
from restock.files import write_table
from restock.ingest.profile.profile import load_profile
from restock.train.run.run_tables import EVAL_EPISODES

TINY = [
    *("--env-steps", "40", "--set", "env.num_envs=4", "--set", "schedule.warmup_env_steps=40"),
    *("--set", "schedule.offline_updates=20", "--set", "network.hidden=[8]"),
    *("--set", "evaluation.episodes=1", "--set", "record.every_updates=10"),
    *("--set", "record.trackers=[]", "--set", "replay.batch_size=16"),
    *("--set", "record.audit_share=0.5", "--set", "replay.ring_capacity=100"),
    *("--set", "env.conditions={nominal=1.0}"),
]
DAMAGES = ("missing", "empty", "cut", "garbage")
FILES = (
    "config.json",
    *("progress.parquet", "strata.parquet", "audit.parquet", "evaluations.parquet"),
    *("sampled_episodes.parquet", "evaluation_buffer.parquet", "practice.parquet"),
    *("eval/episodes.parquet", "checkpoints/best.safetensors", "checkpoints/latest.safetensors"),
)


@pytest.fixture(autouse=True)
def no_charts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Skip charts, which take most of the time of a page."""
    monkeypatch.setattr("restock.report.look.charts._svg", lambda spec: "<svg/>")


def damage(path: Path, how: str) -> None:
    content = path.read_bytes()
    path.chmod(0o644)
    left = {"empty": b"", "cut": content[: len(content) // 2], "garbage": bytes(range(256)) * 4}
    if how == "missing":
        path.unlink()
    else:
        path.write_bytes(left[how])


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a small store, a panel of it and a run on the panel."""
    root = tmp_path_factory.mktemp("whole")
    task = load_profile("warehouse_amr").task
    rows = [recording_transitions(number, episodes=6, task=task) for number in (1, 2)]
    store = write_store(root / "store", rows, task=task)
    panel_of(store, "[each_condition]\nshare = 'natural'\n", root / "panel")
    argv = ["train", "--panel", str(root / "panel"), "--out", str(root / "run")]
    assert cli.main([*argv, *TINY]) == 0
    evaluated = {
        "policy": "agent",
        "perturbation": "none",
        "condition": "nominal",
        "block": "none",
        "episode_seed": 10_000,
        "success": True,
        "return": 1.0,
        **{"bumps": 0, "time_s": 9.0, "layout": "default", "end_x_m": 1.0, "end_y_m": 2.0},
    }
    table = pa.Table.from_pylist([evaluated], schema=EVAL_EPISODES)
    write_table(table, root / "run" / "eval" / "episodes.parquet")
    return root


def run_verbs(run: Path, root: Path, out: Path) -> dict[str, list[str]]:
    """Return one command line per verb that reads a run."""
    path = str(run)
    return {
        "eval": ["eval", path, "--dry-run", "--policies", "agent"],
        "report": ["report", path, "--out", str(out / "r.html")],
        "card": ["report", path, "--card"],
        "compare": ["compare", path, str(root / "run")],
        "diagnose": ["diagnose", path, "--no-twin"],  # the twin reads no file of it
        "trace": ["trace", path],
        "sql": ["sql", path, "FROM audit LIMIT 1"],
        "train": ["train", "--resume", path, "--env-steps", "40"],
        "export": ["export", path, "--to", "onnx", "--out", str(out / "policy.onnx")],
    }


def check(argv: list[str], named: Path, capsys: pytest.CaptureFixture[str]) -> int:
    """Run a command; check that it exits 0, 1 for a refused comparison, or 2 and names the path."""
    code = cli.main(argv)
    err = capsys.readouterr().err
    assert "Traceback" not in err, argv
    assert "an unexpected" not in err, (argv, err)
    if code:
        assert code == 2 or (code == 1 and argv[0] == "compare"), (argv, code, err)
    if code == 2:
        assert str(named) in err, (argv, err)
    return code


@pytest.mark.parametrize(
    ("name", "turn"),
    one_in(6 * len(DAMAGES) + 1, [(name, turn) for name in FILES for turn in range(len(DAMAGES))]),
)
def test_every_verb_reports_damaged_run(name, turn, root, tmp_path, capsys):
    whole = run_verbs(root / "run", root, tmp_path)
    for number, verb in enumerate(whole):
        if number % len(DAMAGES) != turn:  # every verb meets every file, each damage in turn
            continue
        run = tmp_path / verb
        shutil.copytree(root / "run", run)
        damage(run / name, DAMAGES[(number + FILES.index(name)) % len(DAMAGES)])
        check(run_verbs(run, root, tmp_path)[verb], run, capsys)


@pytest.mark.parametrize("how", DAMAGES)
def test_damaged_required_file_is_named(how, root, tmp_path, capsys):
    needed = {
        "report": "strata.parquet",
        "train": "checkpoints/latest.safetensors",
        "eval": "checkpoints/best.safetensors",
        "trace": "audit.parquet",
        "compare": "sampled_episodes.parquet",
    }
    for verb, name in needed.items():
        run = tmp_path / verb
        shutil.copytree(root / "run", run)
        damage(run / name, how)
        # A table that an earlier Restock did not write is empty, so a page can be made without it.
        place = run / name if how != "missing" else run
        code = check(run_verbs(run, root, tmp_path)[verb], place, capsys)
        assert code == 2 or (verb, how) == ("report", "missing")


@pytest.mark.parametrize(
    ("key", "value", "before"),
    [("optimizer.learning_rate", 0.5, "0.001"), ("network.hidden", [9], "[8]"), ("seed", 3, "0")],
)
def test_edited_config_is_not_resumed(key, value, before, root, tmp_path, shell):
    run = Path(shutil.copytree(root / "run", tmp_path / "run"))
    document = json.loads((run / "config.json").read_text())
    config, (*tables, name) = document["config"], key.split(".")
    config["schedule"]["env_steps"] = 41
    for table in tables:
        config = config[table]
    config[name] = value
    (run / "config.json").write_text(json.dumps(document))
    err = shell.err(*run_verbs(run, root, tmp_path)["train"])
    assert f"{run}/config.json: {key} is {value}, but the run was trained with {before}" in err


def store_verbs(store: Path, out: Path) -> list[list[str]]:
    path = str(store)
    return [
        ["sql", path, "SELECT sum(reward), count(conditions) FROM transitions, coverage"],
        ["sql", path, "SELECT avg(novelty) FROM novelty"],
        ["audit", path],
        ["audit", path, "--capacity"],
        ["mix", path, "--mixture", "coverage", "--out", str(out / "panel")],
        ["export", path, "--to", "parquet", "--out", str(out / "x.parquet")],
        ["trace", path, str(1 << 32)],
    ]


@pytest.mark.parametrize("table", ["recordings", "transitions"])
@pytest.mark.parametrize("how", [*DAMAGES, "a page"])
def test_damaged_store_file_is_reported(table, how, root, tmp_path, capsys):
    store = tmp_path / "store"
    shutil.copytree(root / "store", store)
    file = sorted((store / table).glob("*.parquet"))[0]
    if how == "a page":  # the footer is intact, so only reading finds it
        content = file.read_bytes()
        file.write_bytes(content[:8] + bytes(byte ^ 0x55 for byte in content[8:40]) + content[40:])
    else:
        damage(file, how)
    codes = [check(argv, store, capsys) for argv in store_verbs(store, tmp_path)[:6]]
    assert 2 in codes
    if how != "a page":
        assert set(codes) == {2}


@pytest.mark.parametrize("task", ["a key", "{", ""])
def test_task_of_newer_version_is_reported(task, root, tmp_path, shell):
    store = tmp_path / "store"
    shutil.copytree(root / "store", store)
    for file in (store / "recordings").glob("*.parquet"):
        table = pq.read_table(file, partitioning=None)
        rows = table.to_pylist()
        for row in rows:
            newer = json.dumps({**json.loads(row["task_json"]), "hover_m": 3})
            row["task_json"] = newer if task == "a key" else task
        pq.write_table(pa.Table.from_pylist(rows, schema=table.schema), file)
    for argv in store_verbs(store, tmp_path):
        err = shell.err(*argv)
        assert f"{store}: the task in its recordings' manifests cannot be read" in err
        assert "newer Restock" in err


def test_unwritable_target_is_reported(root, tmp_path, capsys):
    store, run, out = str(root / "store"), str(root / "run"), tmp_path / "file"
    out.write_text("a file, where a folder is asked for")
    for argv in (
        ["sql", store, "--export", str(out / "views.sql")],
        ["sql", store, "--export", str(out / "views.duckdb")],
        ["export", store, "--to", "parquet", "--out", str(out / "x.parquet")],
        ["export", run, "--to", "onnx", "--out", str(out / "x.onnx")],
        ["mix", store, "--mixture", "coverage", "--out", str(out / "panel")],
        ["report", run, "--out", str(out / "r.html")],
        ["train", "--out", str(out / "run")],
    ):
        assert check(argv, out, capsys) == 2
    assert out.read_text().startswith("a file")


@pytest.mark.parametrize(
    ("limit", "remedy"), [("0GB", 'write it like "4GB"'), ("1MB", "RESTOCK_MEMORY_LIMIT")]
)
def test_too_small_memory_limit_is_reported(limit, remedy, root, tmp_path, monkeypatch, shell):
    store = str(root / "store")
    monkeypatch.setenv("RESTOCK_MEMORY_LIMIT", limit)
    for argv in (
        ["sql", store, "FROM coverage"],
        ["mix", store, "--mixture", "coverage", "--out", str(tmp_path / "panel")],
        ["audit", store],
        ["audit", store, "--capacity"],
        ["audit", store, "--reward"],
    ):
        err = shell.err(*argv)
        assert "memory limit" in err, argv
        assert remedy in err.splitlines()[-1], argv
        assert "damaged" not in err, argv


def test_non_utf8_path_is_reported(tmp_path, shell):
    place = os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9")
    err = " ".join(shell.err("audit", place).split())
    assert "a path is not UTF-8, as it must be for a store, a panel or a run" in err
    assert r"/caf\xe9/transitions rename the folder" in err


def test_unexpected_error_exits_2_traceback_on_request(monkeypatch, shell):
    def broken(args: list[str]) -> int:
        return {}["a key"]  # type: ignore[no-any-return]

    monkeypatch.setattr(cli, "_dispatch", broken)
    err = shell.err("info", "a.mcap")
    assert "restock info a.mcap: an unexpected KeyError: 'a key'" in err
    assert "RESTOCK_TRACEBACK=1" in err
    assert "Traceback" not in err
    monkeypatch.setenv("RESTOCK_TRACEBACK", "1")
    assert "Traceback" in shell.err("info", "a.mcap")
