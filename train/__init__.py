"""A DQN on logs and in the twin: train it, evaluate it, compare and diagnose runs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from restock.public import lazy

if TYPE_CHECKING:
    from restock.train.comparison.compare import compare as compare
    from restock.train.comparison.diagnose import diagnose as diagnose
    from restock.train.comparison.run_difference import diff_runs as diff_runs
    from restock.train.diagnosis.before_training import (
        diagnose_before_training as diagnose_before_training,
    )
    from restock.train.dqn.algorithm import Algorithm as Algorithm
    from restock.train.dqn.algorithm import Loss as Loss
    from restock.train.dqn.algorithm import TrainingBatch as TrainingBatch
    from restock.train.dqn.config import TrainConfig as TrainConfig
    from restock.train.dqn.network import QNetwork as QNetwork
    from restock.train.evaluation.eval_run import evaluate as evaluate
    from restock.train.evaluation.ope import OpeConfig as OpeConfig
    from restock.train.evaluation.ope import evaluate_run_off_policy as evaluate_run_off_policy
    from restock.train.evaluation.regression import compare_with_baseline as compare_with_baseline
    from restock.train.evaluation.regression import regressed as regressed
    from restock.train.feed.teacher import Teacher as Teacher
    from restock.train.libraries.mixed_feed import FeedOptions as FeedOptions
    from restock.train.libraries.sb3_buffer import MixtureReplayBuffer as MixtureReplayBuffer
    from restock.train.libraries.sb3_buffer import dqn_critic as dqn_critic
    from restock.train.libraries.tianshou_buffer import (
        MixtureVectorReplayBuffer as MixtureVectorReplayBuffer,
    )
    from restock.train.prepare import train as train
    from restock.train.run.replay_audit import ReplayAuditRecord as ReplayAuditRecord
    from restock.train.run.replay_audit import replay_audit as replay_audit
    from restock.train.run.run import Run as Run
    from restock.train.study.study import StudyPlan as StudyPlan
    from restock.train.study.study import load_study as load_study
    from restock.train.study.study_run import run_study as run_study
    from restock.train.view.view import ViewOptions as ViewOptions
    from restock.train.view.view import write_view as write_view
else:
    __getattr__, __dir__, __all__ = lazy(
        __name__,
        {
            "restock.train.comparison.compare": ["compare"],
            "restock.train.comparison.run_difference": ["diff_runs"],
            "restock.train.comparison.diagnose": ["diagnose"],
            "restock.train.diagnosis.before_training": ["diagnose_before_training"],
            "restock.train.dqn.algorithm": ["Algorithm", "Loss", "TrainingBatch"],
            "restock.train.dqn.config": ["TrainConfig"],
            "restock.train.dqn.network": ["QNetwork"],
            "restock.train.evaluation.eval_run": ["evaluate"],
            "restock.train.evaluation.ope": ["OpeConfig", "evaluate_run_off_policy"],
            "restock.train.evaluation.regression": ["compare_with_baseline", "regressed"],
            "restock.train.feed.teacher": ["Teacher"],
            "restock.train.libraries.mixed_feed": ["FeedOptions"],
            "restock.train.libraries.sb3_buffer": ["MixtureReplayBuffer", "dqn_critic"],
            "restock.train.libraries.tianshou_buffer": ["MixtureVectorReplayBuffer"],
            "restock.train.prepare": ["train"],
            "restock.train.run.replay_audit": ["ReplayAuditRecord", "replay_audit"],
            "restock.train.run.run": ["Run"],
            "restock.train.study.study": ["StudyPlan", "load_study"],
            "restock.train.study.study_run": ["run_study"],
            "restock.train.view.view": ["ViewOptions", "write_view"],
        },
    )
