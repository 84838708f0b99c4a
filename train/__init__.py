"""Train a DQN on logs and in the twin, evaluate it, and compare and diagnose runs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from restock.public import lazy

if TYPE_CHECKING:
    from restock.train.dqn.algorithm import Algorithm as Algorithm
    from restock.train.dqn.algorithm import Loss as Loss
    from restock.train.dqn.algorithm import TrainingBatch as TrainingBatch
    from restock.train.dqn.config import TrainConfig as TrainConfig
    from restock.train.dqn.network import QNetwork as QNetwork
    from restock.train.evaluation.eval_run import evaluate as evaluate
    from restock.train.feed.teacher import Teacher as Teacher
    from restock.train.judge.before_training import (
        diagnose_before_training as diagnose_before_training,
    )
    from restock.train.judge.compare import compare as compare
    from restock.train.judge.diagnose import diagnose as diagnose
    from restock.train.libraries.sb3_buffer import MixtureReplayBuffer as MixtureReplayBuffer
    from restock.train.libraries.sb3_buffer import dqn_critic as dqn_critic
    from restock.train.prepare import train as train
    from restock.train.run.replay_audit import replay_audit as replay_audit
    from restock.train.run.run import Run as Run
else:
    __getattr__, __dir__, __all__ = lazy(__name__)
