"""Check true conditions and exposures of the twin against their causes and the rules."""

from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from restock.ingest.profile.profile import load_profile
from restock.ingest.store.transitions import label_table
from restock.ingest.task.conditions import label, shipped
from restock.ingest.task.schema import true_names
from restock.ingest.task.task import STORED_SIGNALS, Body, Rewards, Task
from restock.train.twin.env.drivers import PlannerFollower
from restock.train.twin.env.navigation import EXPOSURES, Truth
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.missions import KINDS
from restock.train.twin.physics.episode import EpisodeSpec

STORED = [signal.name for signal in STORED_SIGNALS]


def test_truth_limits_follow_robot_size() -> None:
    small = Task(
        body=Body(0.2, 0.2),
        actions=((0.0, 0.0), (0.2, 0.0)),
        rewards=Rewards(tight_clearance_m=0.06),
    )
    usual = load_profile("warehouse_amr").task
    no = np.zeros(2, np.bool_)
    for task, near, room in (
        (small, [True, False], [False, False]),
        (usual, [True, True], [True, True]),
    ):
        truth = Truth(task, 2)
        reported = truth.condition(no, no, np.array([0.05, 0.1]))
        assert [text == "near_collision" for text in reported] == near
        truth.condition(no, no, np.full(2, 0.16))  # .16 m is room again for the small one alone
        reported = truth.condition(no, no, np.full(2, 0.16))
        assert [text == "recovery" for text in reported] == room
    assert (small.slip_limit_mps, usual.slip_limit_mps) == (0.03, 0.15)


@pytest.mark.long
def test_truth_matches_cause_and_rules_find_it() -> None:
    """Compare the truth with the kind of mission, and with the labels from signals."""
    reported: dict[str, set[tuple[str, int]]] = {name: set() for name in EXPOSURES}
    true: dict[str, set[tuple[str, int]]] = {name: set() for name in EXPOSURES}
    conditions: dict[str, set[str]] = {kind: set() for kind in KINDS}
    for kind in KINDS:
        made = WarehouseVectorEnv(12)
        made.set_episodes([EpisodeSpec(kind, seed) for seed in range(12)])
        made.reset(seed=0)
        driver = PlannerFollower(epsilon=0.0)
        steps: list[dict[str, Any]] = []
        number: list[Any] = []
        for _ in range(80):
            at = made.episode_number.copy()
            steps.append({name: column.copy() for name, column in made.signals.items()})
            number.append(at)
            *_, info = made.step(driver.act(made, made.observation)[0])
            conditions[kind] |= set(info["true_condition"][at >= 0].tolist())
            for env in np.flatnonzero(at >= 0).tolist():
                for name in true_names(str(info["true_exposure"][env])):
                    true[name].add((kind, int(at[env])))
        table = label_table(
            {name: np.stack([row[name] for row in steps], axis=1).ravel() for name in STORED},
            np.stack(number, axis=1).ravel(),
            np.tile(np.arange(80), 12),
            pa.table({}),
        ).filter(pa.array(np.stack(number, axis=1).ravel() >= 0))
        for name, held in label(table, list(shipped(kind="exposure").values())).items():
            episodes = table["episode_index"].to_numpy()[held]
            reported[name] |= {(kind, int(episode)) for episode in np.unique(episodes)}
    causes = {"closing_traffic": "near_collision", "plan_blocked": "blocked_aisle",
              "slippery_floor": "wheel_slip"}  # fmt: skip
    for name, cause in causes.items():
        assert {kind for kind, _ in true[name]} == {cause}
        assert len(true[name]) >= 8
        assert len(reported[name] & true[name]) >= 0.8 * len(true[name])
    for name in ("closing_traffic", "slippery_floor"):
        assert len(reported[name] & true[name]) >= 0.8 * len(reported[name])
    # A person on the plan cannot be distinguished from a pallet.
    assert {kind for kind, _ in reported["plan_blocked"]} <= {"blocked_aisle", "near_collision"}
    for name in ("wheel_slip", "blocked_aisle"):
        assert [kind for kind in KINDS if name in conditions[kind]] == [name]
    assert {"near_collision", "recovery"} <= conditions["near_collision"]
