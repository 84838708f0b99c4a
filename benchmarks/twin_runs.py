"""What benchmarks of policies share: a run that is trained once, and missions that are driven."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from harness import once, run_restock

from restock.ingest.profile.profile import load_profile
from restock.train.evaluation.evaluate import EpisodeResult, fixed_episodes, run_episodes
from restock.train.run.run import Run
from restock.train.study.study_run import train_words
from restock.train.twin.env.interface import Policy
from restock.train.twin.env.vector_env import WarehouseVectorEnv


def trained(path: Path, settings: Sequence[str], panel: Path | None = None) -> Run:
    """Return the run at a path, trained or resumed where it has not ended."""

    def train() -> None:
        run_restock(train_words(path, settings, panel))

    once(path / "done", [*settings, str(panel)], train)
    return Run.open(path)


def drive_missions(
    policy: Policy, kinds: Sequence[str], episodes: int, first_seed: int
) -> list[EpisodeResult]:
    """Drive so many fixed missions of each kind with the stand-in on the twin's own floor."""
    profile = load_profile("warehouse_amr")
    env = WarehouseVectorEnv(
        32, task=profile.task, seed=0, nav_command=profile.inputs.nav_command is not None
    )
    return run_episodes(
        env,
        policy,
        fixed_episodes(kinds, episodes, first_seed),
        control_period_s=profile.task.control_period_s,
        time_limit_steps=profile.task.time_limit_steps,
    )
