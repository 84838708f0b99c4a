"""Training runs on the corridor of `support.toy_twin`: short, equal where nothing differs."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch

from restock.replay.sampling.packed_rows import row_width
from restock.train.dqn.config import TrainConfig, parse_config
from restock.train.feed.logs import Coded, Logs
from restock.train.feed.teacher import open_teacher
from restock.train.loop import train
from restock.train.run.run import Run
from restock.train.run.run_tables import TABLES
from restock.train.session import Session, open_session
from support.toy_twin import CELLS, CONDITIONS, TASK, ToyTwin

SMALL: dict[str, Any] = {
    "network": {"hidden": [32, 32]},
    "loss": {"discount": 0.9, "conservative": 0.0},
    "optimizer": {"learning_rate": 3e-3},
    "target": {"rule": "polyak", "tau": 0.05},
    "replay": {"batch_size": 32, "logs_share": 0.5, "ring_capacity": 2000},
    "schedule": {
        "env_steps": 1600,
        "warmup_env_steps": 200,
        "offline_updates": 60,
        "updates_per_env_step": 0.25,
    },
    "epsilon": {"start": 1.0, "end": 0.1, "steps": 800},
    "env": {"num_envs": 4, "conditions": {"nominal": 0.5, "wheel_slip": 0.5}},
    "evaluation": {"every_env_steps": 800, "episodes": 3},
    "record": {
        "every_updates": 50,
        "audit_share": 0.1,
        "checkpoint_every_env_steps": 400,
        "trackers": (),
    },
}
CLOCKED = {"wall_s", "env_steps_per_s", "updates_per_s"}  # the only columns that time decides


def config(**changes: Any) -> TrainConfig:
    document = {**SMALL, **changes}
    for key, value in changes.items():
        if isinstance(value, dict) and isinstance(SMALL.get(key), dict) and "rule" not in value:
            document[key] = {**SMALL[key], **value}
    return parse_config(document, where="test")


def logs(rows: int = 200) -> Logs:
    """Return logged steps of someone who mostly drives forward, a few of them slipping."""
    rng = np.random.default_rng(0)
    size = TASK.observation_size
    packed = np.zeros((rows, row_width(size)), np.float32)
    cell = rng.integers(CELLS - 1, size=rows)
    action = rng.choice(3, size=rows, p=[0.1, 0.7, 0.2])
    slips = (rng.random(rows) < 0.2) & (action == 1)
    following = np.clip(cell + np.where(slips, 0, np.array([0, 1, -1])[action]), 0, CELLS - 1)
    packed[np.arange(rows), cell] = 1
    packed[np.arange(rows), size + following] = 1
    arrived = following == CELLS - 1
    packed[:, -3:] = np.stack([action, np.where(arrived, 1.0, -0.05), 0.9 * ~arrived], axis=1)
    names = np.where(slips, "wheel_slip", "nominal")
    return Logs(
        rows=torch.from_numpy(packed),
        strata=["nominal", "wheel_slip"],
        timings=["pre", "post"],
        stratum_rows=[np.flatnonzero(~slips), np.flatnonzero(slips)],
        shares=np.array([0.75, 0.25]),
        weights=None,
        as_of_ns=10 * 86_400_000_000_000,
        transition_id=np.arange(rows) + 1000,
        stamp_ns=np.arange(rows, dtype=np.int64) * 86_400_000_000_000 // 100,
        condition=Coded.of(pa.chunked_array([names.tolist()])),
        behaviour_policy=Coded.of(pa.chunked_array([["planner", "operator"] * (rows // 2)])),
        behaviour_version=Coded.of(pa.chunked_array([pa.nulls(rows, pa.string())])),
        episode=Coded.of(pa.chunked_array([["a/0"] * rows])),
    )


def session(path: Path, settings: TrainConfig, *, resume: bool = False, **parts: Any) -> Session:
    run = Run.open(path) if resume else Run.create(path, {})
    return open_session(
        run,
        settings,
        task=TASK,
        conditions=parts.get("conditions", CONDITIONS),
        env=ToyTwin(settings.env.num_envs, settings.env.conditions),
        evaluation_env=ToyTwin(3),
        logs=parts.get("logs", logs()),
        teacher=open_teacher(
            settings.teacher, TASK, seed=settings.seed, given=parts.get("teacher")
        ),
        resume=resume,
    )


def run_to_end(path: Path, settings: TrainConfig, **parts: Any) -> Session:
    live = session(path, settings, **parts)
    train(live)
    live.close()
    return live


def tables(path: Path) -> dict[str, pa.Table]:
    return {
        name: pq.read_table(path / f"{name}.parquet").drop_columns(
            [column for column in schema.names if column in CLOCKED]
        )
        for name, schema in TABLES.items()
    }


def assert_same_run(first: Session, second: Session) -> None:
    for a, b in (
        (first.learner.network, second.learner.network),
        (first.learner.target_network, second.learner.target_network),
        (first.learner.policy, second.learner.policy),
    ):
        for name, value in a.state_dict().items():
            assert torch.equal(value, b.state_dict()[name]), name
    np.testing.assert_array_equal(first.ring.rows, second.ring.rows)
    one, two = tables(first.run.path), tables(second.run.path)
    for name in one:
        assert one[name].equals(two[name]), name
