"""What is missing before the twin and a policy can be judged is told in hours of driving."""

from pathlib import Path

import pytest
from support.stores import TASK

from restock.replay.store.store import Store
from restock.train.evaluation.ope import EssGate
from restock.train.judge.before_training import policy_evidence

PERIOD_S = TASK.control_period_s


def test_hours_follow_from_the_episodes(store_path: Path) -> None:
    with Store(store_path) as store:
        rows, episodes = store.sql(
            "SELECT count(*), count(DISTINCT episode_id) FROM transitions"
        ).fetchall()[0]
        policy = policy_evidence(store, 0.1, EssGate(episodes=episodes))
        enough = policy_evidence(store, 0.5, EssGate(episodes=1))
    driven_h = rows * PERIOD_S / 3600
    assert policy.more_h == pytest.approx(9 * driven_h)  # a tenth is held out
    assert f"at least {9 * driven_h:.2g} h more" in str(policy)
    assert enough.more_h == 0
    assert str(enough).endswith(": enough")
