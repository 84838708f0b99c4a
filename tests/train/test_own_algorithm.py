"""Train with a custom algorithm in one file."""

from pathlib import Path

import pytest
import torch
from support.paths import ROOT
from support.toy_run import config, run_to_end
from support.toy_twin import CELLS, TASK

from restock.errors import ConfigError
from restock.train.dqn.learner import Learner

EXAMPLE = ROOT / "docs/examples/qr_dqn.py"


def test_qr_dqn_example_learns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLE.parent))
    assert len(EXAMPLE.read_text().splitlines()) <= 150
    live = run_to_end(tmp_path / "run", config(loss={"algorithm": "qr_dqn:QRDQN"}))
    assert live.learner.gradient_steps > 300
    observation = torch.eye(TASK.observation_size)[: CELLS - 1]
    quantiles = live.learner.policy.quantiles(observation)  # type: ignore[operator, union-attr]
    assert quantiles.shape == (CELLS - 1, 3, 32)
    forward = live.learner.policy(observation).argmax(dim=1) == 1
    assert forward.float().mean() > 0.5


@pytest.mark.parametrize("name", ["c52", "no_such_module:X", "math:Missing"])
def test_unknown_algorithm_is_rejected(name: str) -> None:
    with pytest.raises(ConfigError, match=r"loss\.algorithm"):
        Learner(config(loss={"algorithm": name}), TASK.observation_size, 3)
