"""Settings that were removed: runs that did not use them stay as they were, others are refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from support.finished_runs import document, make_run
from support.kept_run import kept_run

from restock.cli import main
from restock.errors import ConfigError
from restock.train.dqn.config import TrainConfig, load_config, parse_config
from restock.train.evaluation.policies import load_agent
from restock.train.run.run import Run

OFF: dict[str, dict[str, Any]] = {  # as a run from before has them
    "network": {"quantiles": 0, "ensemble": 1},
    "loss": {"munchausen": 0.0, "munchausen_temperature": 0.03, "munchausen_floor": -1.0},
}
TINY = [
    *("--set", "env.num_envs=2", "--set", "schedule.warmup_env_steps=20"),
    *("--set", "network.hidden=[8]", "--set", "teacher.hidden=[8]"),
    *("--set", "evaluation.episodes=1", "--set", "record.tensorboard=false"),
    *("--set", "replay.batch_size=8", "--set", "env.conditions={nominal = 1.0}"),
]


def aged(run: Path, **changes: dict[str, Any]) -> Path:
    """The run as one from before the settings were removed, with some of them changed."""
    file = run / "config.json"
    whole = json.loads(file.read_text("utf-8"))
    for table, values in OFF.items():
        whole["config"][table] |= values | changes.get(table, {})
    file.write_text(json.dumps(whole), "utf-8")
    return run


def test_settings_that_were_off_are_left_out() -> None:
    unused = {"loss": OFF["loss"] | {"munchausen_temperature": 0.5, "munchausen_floor": -9.0}}
    for old in (OFF, unused, {"loss": {"munchausen_floor": -2.0}}):
        assert parse_config(old, where="test") == TrainConfig()
    kept = load_config(None, ["network.ensemble=1", "network.layer_norm=false", "loss.n_step=5"])
    assert (kept.network.layer_norm, kept.loss.n_step) == (False, 5)


@pytest.mark.parametrize(
    ("setting", "key"),
    [
        ("network.quantiles=8", "network.quantiles"),
        ("network.ensemble=4", "network.ensemble"),
        ("loss.munchausen=0.9", "loss.munchausen"),
    ],
)
def test_settings_that_were_on_are_refused_by_name(setting: str, key: str) -> None:
    with pytest.raises(ConfigError, match=f"`{key}` was removed") as refused:
        load_config(None, [setting, "loss.munchausen_temperature=0.03"])
    assert "docs/evidence.md" in str(refused.value)
    assert "leave it out" in str(refused.value)


def test_what_is_no_table_is_still_said(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="`network`: Expected `object`"):
        parse_config({"network": 3}, where="test")


def test_an_old_run_is_compared_with_a_new_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old = aged(make_run(tmp_path / "old", document(0)))
    new = make_run(tmp_path / "new", document(1, config__network__layer_norm=False))
    assert main(["compare", str(old), "--against", str(new), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["verdict"] == "comparable"
    assert [row["setting"] for row in found["differences"]] == ["config.network.layer_norm"]
    assert main(["diff", str(old), str(new), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)["settings"]
    assert {row["setting"] for row in said} == {"config.seed", "config.network.layer_norm"}


def test_a_run_that_used_one_differs_by_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old = aged(make_run(tmp_path / "old", document(0)), network={"ensemble": 4})
    new = make_run(tmp_path / "new", document(1))
    assert main(["compare", str(old), "--against", str(new), "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["differences"]
    assert (row["setting"], row["first"], row["second"]) == ("config.network.ensemble", 4, None)


def test_the_policy_of_an_old_run_is_opened(tmp_path: Path) -> None:
    new, old = kept_run(tmp_path / "new"), aged(kept_run(tmp_path / "old"))
    weights = [load_agent(Run.open(run)).network.state_dict() for run in (new, old)]
    assert all(bool((weights[0][name] == value).all()) for name, value in weights[1].items())
    with pytest.raises(ConfigError, match=r"`network\.ensemble` was removed"):
        load_agent(Run.open(aged(old, network={"ensemble": 4})))


def test_an_old_run_is_resumed_and_has_its_card(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert main(["train", "--out", str(out), "--env-steps", "40", *TINY]) == 0
    assert main(["train", "--resume", str(aged(out)), "--env-steps", "60"]) == 0
    assert Run.open(out).table("progress")["env_steps"][-1].as_py() >= 60
    used = aged(out, loss={"munchausen": 0.9})
    assert main(["report", str(used), "--card", "--json"]) == 0
    assert main(["train", "--resume", str(used), "--env-steps", "80"]) == 2
    assert "`loss.munchausen` was removed" in capsys.readouterr().err
