"""Export policies as ONNX, drive them, and reject files of another task."""

import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from support.kept_run import kept_run
from support.shell import Shell

from restock.cli import main
from restock.errors import ConfigError
from restock.ingest.profile.profile import load_profile
from restock.train.dqn.algorithm import DQN
from restock.train.dqn.config import LossConfig, NetworkConfig, parse_config
from restock.train.dqn.learner import greedy_actions
from restock.train.evaluation.onnx_policy import OnnxPolicy, to_onnx
from restock.train.evaluation.policies import make_learner

onnx = pytest.importorskip("onnx")
runtime = pytest.importorskip("onnxruntime")
TASK = load_profile("warehouse_amr").task


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"network": {"layer_norm": False}},
        {"teacher": {"source": "planner", "margin": 0.05}},
        {"teacher": {"source": "logs", "ratio": 0.9}},
    ],
    ids=str,
)
def test_onnx_values_and_actions_match_torch(settings: dict[str, Any]) -> None:
    network = {"hidden": [32, 24], **settings.get("network", {})}
    policy = make_learner(parse_config({**settings, "network": network}, where="test"), TASK).policy
    session = runtime.InferenceSession(to_onnx(policy).SerializeToString())
    rng, known = np.random.default_rng(0), TASK.observation_names.index("nav_known")
    observation = rng.normal(size=(512, TASK.observation_size)).astype(np.float32)
    observation[:, known] = rng.random(512) < 0.7  # 1 if navigation proposes a command
    observation[observation[:, known] == 0, known:] = 0
    values, action = session.run(["values", "action"], {"observation": observation})
    with torch.no_grad():
        expected = policy(torch.from_numpy(observation)).numpy()
    filtered = np.isinf(expected).mean()
    assert 0 < filtered < 1 if "ratio" in settings.get("teacher", {}) else filtered == 0
    np.testing.assert_allclose(values, expected, atol=1e-5)
    np.testing.assert_array_equal(action, greedy_actions(policy, observation))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a run that kept a policy."""
    return kept_run(tmp_path_factory.mktemp("runs") / "a")


def test_onnx_file_describes_its_inputs(run: Path, tmp_path: Path, shell: Shell) -> None:
    out = tmp_path / "p.onnx"
    document = shell.json("export", run, "--to", "onnx", "--out", out)
    assert onnx.load(out).ir_version == 8  # the first with opset 18; ONNX Runtime 1.16 reads 9
    session = runtime.InferenceSession(str(out))
    meta = session.get_modelmeta().custom_metadata_map
    assert json.loads(meta["actions"]) == [list(action) for action in TASK.actions]
    assert json.loads(meta["observation"]) == TASK.observation_names
    assert meta["task_hash"] == document["task_hash"] == TASK.hash
    assert msgspec.json.decode(meta["task"], type=type(TASK)) == TASK
    assert meta["version"] == "a@7"


def test_eval_of_onnx_policy_matches_agent(run: Path, tmp_path: Path, shell: Shell) -> None:
    out = tmp_path / "p.onnx"
    assert main(["export", str(run), "--to", "onnx", "--out", str(out)]) == 0
    policies = f"agent,onnx:{out},run:{run}"
    argv = ["eval", str(run), "--episodes", "1", "--perturbations", "none", "--json"]
    rows = json.loads(shell.out(*argv, "--policies", policies))["results"]
    by = {
        policy: [
            (r["condition"], r["success"], r["bumps_per_episode"], r["return"])
            for r in rows
            if r["policy"] == policy
        ]
        for policy in ("agent", f"onnx:{out}", f"run:{run}")
    }
    assert by["agent"] == by[f"run:{run}"]
    assert [row[:3] for row in by["agent"]] == [row[:3] for row in by[f"onnx:{out}"]]


def test_invalid_onnx_policy_is_rejected(run: Path, tmp_path: Path, shell: Shell) -> None:
    out = tmp_path / "p.onnx"
    argv = ["export", str(run), "--to", "onnx", "--out", str(out)]
    assert main(argv) == 0
    assert "already exists" in shell.err(*argv)  # the file exists
    (tmp_path / "text.onnx").write_text("hello")
    other = DQN(LossConfig()).make_network(NetworkConfig(hidden=(4,)), 3, 2)
    (tmp_path / "other.onnx").write_bytes(to_onnx(other).SerializeToString())
    for name, message in (
        ("missing.onnx", "no such file"),
        (".", r"is a folder, not an ONNX file\n.*restock export"),
        ("text.onnx", r"is not an ONNX model.*\n.*restock export"),
        ("other.onnx", r"the task's observation is \(N, "),
    ):
        with pytest.raises(ConfigError, match=message):
            OnnxPolicy(tmp_path / name, TASK)
    changed = msgspec.structs.replace(TASK, time_limit_steps=7)
    with pytest.raises(ConfigError, match="was made for task"):
        OnnxPolicy(out, changed)
    assert main(["eval", str(run), "--policies", f"onnx:{tmp_path / 'text.onnx'}"]) == 2
    assert not (run / "eval").exists() or not list((run / "eval").glob("*.tmp"))


def test_eval_reads_perturbation_file(run: Path, tmp_path: Path, shell: Shell) -> None:
    wet = tmp_path / "wet.toml"
    wet.write_text('name = "wet"\nfriction_scale = 0.5\n')
    argv = ["eval", str(run), "--dry-run", "--json", "--perturbations"]
    document = json.loads(shell.out(*argv, f"none,{wet}"))["perturbations"]
    assert {name: table["friction_scale"] for name, table in document.items()} == {
        "none": 1.0,
        str(wet): 0.5,
    }
    for text, why in (
        ("[ranges]\ngain = [0.9, 1.0]\n", "is a schedule"),
        ("timestep_s = 0.005\n", "is for a timestep of 0.005 s"),
        ("grip = 1.0\n", "grip"),
    ):
        wet.write_text(text)
        assert why in shell.err(*argv, wet).replace("\n", " ")
    assert main([*argv, str(tmp_path / "none.toml")]) == 2
