"""What the twin gave goes into a store like a robot's log: once, whole, with its labels."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa
import pytest
from support.paths import ROOT

import restock
from restock.ingest.pipeline import ingest
from restock.ingest.profile.profile import Profile, load_profile
from restock.ingest.store.manifest import definitions
from restock.ingest.store.transitions import episode_ends
from restock.ingest.store.writer import StoreWriter
from restock.ingest.task.schema import SIGNAL_COLUMNS, STEP_BITS
from restock.replay.sampling.ring import FreshRing
from restock.train.feed.collector import Collector, ring_conditions
from restock.train.feed.fresh_log import (
    FreshEpisode,
    FreshLog,
    episode_files,
    flush,
    write_episodes,
)
from restock.train.run import checkpoint
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.physics.perturbation import Schedule

ENVS, LONGEST = 3, 25


@dataclass
class Collecting:
    """The warehouse with short episodes, driven at random, and what went into the ring."""

    folder: Path
    n_step: int = 1
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    steps: int = 0

    def __post_init__(self) -> None:
        shipped = load_profile("warehouse_amr")
        # Every episode goes on to the time limit: at random the robot bumps into something.
        task = msgspec.structs.replace(
            shipped.task, time_limit_steps=LONGEST, bump_terminates=False
        )
        self.profile: Profile = msgspec.structs.replace(shipped, task=task)
        drawn = Schedule(ranges={"payload_kg": (10.0, 60.0)}, name="laden")
        self.env = WarehouseVectorEnv(ENVS, seed=1, task=task, perturbation=drawn)
        self.ring = FreshRing(
            500,
            ENVS,
            task.observation_size,
            discount=0.9,
            n_step=self.n_step,
            conditions=ring_conditions(self.profile.conditions),
        )
        self.collector = Collector(self.env, self.ring, self.profile.conditions, task, None)
        self.collector.reset(1)

    def keep(self) -> FreshLog:
        return self.collector.keep(self.folder / "fresh")

    def drive(self, steps: int) -> None:
        for _ in range(steps):
            action = self.rng.integers(0, 9, ENVS)
            probability = self.rng.uniform(0.1, 1.0, ENVS).astype(np.float32)
            self.collector.start(action, probability)
            self.collector.finish(
                env_steps=self.steps * ENVS, gradient_steps=self.steps, acting_step=self.steps
            )
            self.steps += 1
            self.collector.label(all_of_them=True)


@pytest.fixture
def collecting(tmp_path: Path) -> Collecting:
    made = Collecting(tmp_path / "run")
    made.keep()
    made.drive(2 * LONGEST + 5)
    return made


def test_a_flushed_run_is_a_recording_like_any_other(collecting, tmp_path):
    done = flush(collecting.folder, StoreWriter(tmp_path / "store"), collecting.profile)
    assert (done.status, done.episodes) == ("written", 2 * ENVS)
    store = restock.open(tmp_path / "store")
    (recording,) = store.sql("FROM recordings").to_arrow_table().to_pylist()
    assert recording["format"] == "twin"
    assert recording["ticks"] == recording["transitions"] + recording["episode_ends"]
    rows = store.sql(
        "FROM transitions JOIN recordings USING (recording_id) WHERE format = 'twin'"
        " ORDER BY episode_index, step_index"
    )
    rows = rows.to_arrow_table().to_pylist()
    assert len(rows) == done.transitions == 2 * ENVS * LONGEST
    # The ring has the same steps (n_step is 1): by observation, action and reward.
    ring, place = collecting.ring, {}
    for slot in range(len(ring)):
        place[ring.rows[slot, : ring.observation_size].tobytes()] = slot
    labels = (*ring.conditions, None)
    for row in rows:
        slot = place[np.array(row["observation"], np.float32).tobytes()]
        packed = ring.rows[slot]
        assert row["action"] == packed[ring.columns["action"]][0]
        assert row["reward"] == packed[ring.columns["reward"]][0]
        assert (packed[ring.columns["discount"]][0] == 0) == row["terminated"]
        np.testing.assert_array_equal(
            np.array(row["next_observation"], np.float32), packed[ring.columns["next_observation"]]
        )
        assert row["step_index"] == ring.meta["episode_step"][slot]
        assert row["primary_condition"] == labels[ring.condition(np.array([slot]))[0]]
        assert row["action_probability"] == ring.meta["action_probability"][slot]
        assert row["behaviour_policy"] == "dqn"
        began = ring.meta["policy_version"][slot] - row["step_index"]
        assert row["behaviour_version"] == f"run@{began}"
    assert {row["perturbation"] for row in rows} == {"laden"}
    payloads = {row["episode_index"]: dict(row["perturbation_values"]) for row in rows}
    assert {tuple(values) for values in payloads.values()} == {("payload_kg",)}
    assert len({values["payload_kg"] for values in payloads.values()}) == 2 * ENVS
    last = [row for row in rows if row["truncated"] or row["terminated"]]
    assert [row["step_index"] for row in last] == [LONGEST - 1] * 2 * ENVS
    stamps = np.array([row["stamp_ns"] for row in rows])
    assert (np.diff(stamps) > 0).all()


def test_truncated_episodes_bootstrap_at_their_last_step(tmp_path):
    """The ring's rows of three steps against the single steps that the twin returned."""
    made = Collecting(tmp_path / "run", n_step=3)
    step_of: dict[tuple[int, int], tuple[Any, ...]] = {}
    for number in range(2 * LONGEST):
        before, action = made.collector.observation.copy(), made.rng.integers(0, 9, ENVS)
        returned = made.collector.start(action, np.ones(ENVS, np.float32))
        after, reward, terminated, truncated, info = returned
        assert not terminated.any()
        assert truncated.all() == truncated.any() == (number % LONGEST == LONGEST - 1)
        after = info["final_obs"] if truncated.any() else after  # not the next episode's first
        for env in range(ENVS):
            step_of[env, number] = before[env], action[env], reward[env], after[env].copy()
        made.collector.finish(env_steps=number * ENVS, gradient_steps=0, acting_step=0)
    ring, columns = made.ring, made.ring.columns
    assert len(ring) == len(step_of)
    slot_of = {
        packed[columns["observation"]].tobytes(): slot
        for slot, packed in enumerate(ring.rows[: len(ring)])
    }
    for (env, number), (observation, action, *_) in step_of.items():
        horizon = min(3, LONGEST - number % LONGEST)
        span = [step_of[env, number + ahead] for ahead in range(horizon)]
        slot = slot_of[observation.tobytes()]
        packed = ring.rows[slot]
        total = sum(0.9**ahead * step[2] for ahead, step in enumerate(span))
        assert packed[columns["reward"]][0] == pytest.approx(total, abs=1e-5)
        assert packed[columns["discount"]][0] == pytest.approx(0.9**horizon, rel=1e-6)
        assert packed[columns["action"]][0] == action
        np.testing.assert_array_equal(packed[columns["next_observation"]], span[-1][3])
        assert ring.meta["horizon"][slot] == horizon


def test_rows_are_those_that_ingest_makes_of_the_same_steps(tmp_path: Path) -> None:
    """The steps of a recording, given back as episodes of the twin: layout and meaning agree."""
    profile, writer = load_profile("warehouse_amr"), StoreWriter(tmp_path / "store")
    ingested = ingest(ROOT / "sample_logs" / "amr_tuesday", profile, store=writer).manifest
    logged = writer.rows(ingested["recording_id"], ingested["ingest_id"])
    write_episodes(tmp_path / "run" / "fresh" / "000000.episodes", episodes_of(logged, profile))
    flush(tmp_path / "run", writer, profile)
    (manifest,) = (row for row in writer.live().to_pylist() if row["format"] == "twin")
    flushed = writer.rows(manifest["recording_id"], manifest["ingest_id"])
    assert flushed.schema.equals(logged.schema)
    assert manifest.keys() == writer.live(ingested["recording_id"]).to_pylist()[0].keys()
    counts = ("transitions", "episodes", "label_scores", *definitions(profile))
    assert [manifest[name] for name in counts] == [ingested[name] for name in counts]
    both = [episode_ends(rows) for rows in (logged, flushed)]
    assert both[0] is not None
    assert both[1] is not None
    shifted = {"stamp_ns", "pose_stamp_ns"}  # episodes are laid out one after the other
    for before, after in ((logged, flushed), both):
        for name in before.column_names:
            if name not in shifted | DIFFERENT:
                assert after[name].equals(before[name]), name
    # A transition's id is its recording's number and its tick; episodes share no ticks here.
    ticks = flushed["transition_id"].to_numpy() & ((1 << STEP_BITS) - 1)
    assert ticks.tolist() == (np.arange(len(ticks)) + flushed["episode_index"].to_numpy()).tolist()
    assert set(flushed["recording_id"].to_pylist()) == {manifest["recording_id"]}
    for name, text in definitions(profile).items():
        assert set(flushed[name].to_pylist()) == {text}


# What differs between a recording and the twin's episodes by what it means: who and where from.
DIFFERENT = {"transition_id", "recording_id", "episode_id", "ingest_id", "source_file"}
DIFFERENT |= {"behaviour_policy", "behaviour_version", "perturbation", "perturbation_values"}
DIFFERENT |= {"action_residual", "logged_ns"}  # the twin has no recorder


def episodes_of(rows: pa.Table, profile: Profile) -> list[FreshEpisode]:
    """Return a recording's rows as the twin's episodes are kept."""
    ends = episode_ends(rows)
    assert ends is not None
    names = [column.name for column in SIGNAL_COLUMNS]
    observation = np.array(rows["observation"].to_pylist(), np.float32)
    final = np.array(rows["next_observation"].to_pylist(), np.float32)
    conditions = [condition.name for condition in profile.conditions]
    episodes = []
    for number in range(len(ends)):
        inside = np.flatnonzero(rows["episode_index"].to_numpy() == number)
        part = rows.take(pa.array(inside))
        signals = pa.concat_tables(
            [part.select(names), ends.slice(number, 1).select(names)], promote_options="permissive"
        )
        named = [set(held) for held in part["conditions"].to_pylist()] + [set()]
        episodes.append(
            FreshEpisode(
                count=len(part),
                terminated=part["terminated"][-1].as_py(),
                version=0,
                zones=np.array([*part["zone"].to_pylist(), "elsewhere"]),
                observation=np.concatenate([observation[inside], final[inside[-1:]]]),
                action=part["action"].to_numpy(),
                probability=part["action_probability"].to_numpy(),
                reward=part["reward"].to_numpy(),
                progress_m=part["progress_m"].to_numpy(),
                truth=np.array(part["true_condition"].to_pylist(), "<U64"),
                exposure=np.array(part["true_exposure"].to_pylist(), "<U64"),
                signals={name: signals[name].to_numpy() for name in names},
                labels={name: np.array([name in held for held in named]) for name in conditions},
                perturbation="nominal",
                perturbation_values="{}",
                layout="default",
            )
        )
    return episodes


def test_the_same_episodes_are_flushed_once(collecting: Collecting, tmp_path: Path) -> None:
    writer = StoreWriter(tmp_path / "store")
    first, again = (flush(collecting.folder, writer, collecting.profile) for _ in range(2))
    assert (again.status, again.recording_id) == ("unchanged", first.recording_id)
    collecting.drive(LONGEST)
    more = flush(collecting.folder, writer, collecting.profile)
    assert more.recording_id != first.recording_id
    assert len(writer.live()) == 2


@pytest.mark.long
def test_what_is_kept_goes_on_exactly_from_a_checkpoint(tmp_path: Path) -> None:
    def state(made: Collecting) -> dict[str, Any]:
        return {
            "env": made.env.state_dict(),
            "ring": made.ring.state_dict(),
            "collector": made.collector.state_dict(),
        }

    first = Collecting(tmp_path / "first" / "run")
    first.keep()
    first.drive(LONGEST + 9)
    checkpoint.save(tmp_path / "checkpoint", state(first))
    first.drive(30)

    second = Collecting(tmp_path / "first" / "run")
    second.rng = np.random.default_rng(0)
    for _ in range(LONGEST + 9):
        second.rng.integers(0, 9, ENVS), second.rng.uniform(0.1, 1.0, ENVS)
    saved = checkpoint.load(tmp_path / "checkpoint")
    second.env.load_state_dict(saved["env"])
    second.ring.load_state_dict(saved["ring"])
    second.collector.load_state_dict(saved["collector"])
    second.steps = LONGEST + 9
    before = flush(first.folder, StoreWriter(tmp_path / "store"), first.profile)
    second.keep()  # what was written after the checkpoint goes, and comes again
    assert len(episode_files(second.folder / "fresh")) == 1
    second.drive(30)
    after = flush(second.folder, StoreWriter(tmp_path / "store"), second.profile)
    assert (after.status, after.recording_id) == ("unchanged", before.recording_id)


def test_a_step_that_blew_up_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = Collecting(tmp_path / "run")
    log = made.keep()
    made.drive(10)
    simulation = made.env.simulation
    drive = simulation.drive

    def blow_up(command: Any) -> None:
        drive(command)
        simulation.diverged = np.array([True, False, False])

    with monkeypatch.context() as patch:
        patch.setattr(simulation, "drive", blow_up)
        made.drive(1)
    made.drive(LONGEST)
    assert log.dropped_steps == 1
    writer = StoreWriter(tmp_path / "store")
    done = flush(made.folder, writer, made.profile, log.dropped_steps)
    (manifest,) = writer.live(done.recording_id).to_pylist()
    assert manifest["drops"] == [{"reason": "physics blew up", "count": 1}]
    assert manifest["ticks"] == manifest["transitions"] + manifest["episode_ends"] + 1
    rows = restock.open(tmp_path / "store").sql(
        "SELECT step_index, terminated FROM transitions WHERE truncated OR terminated"
    )
    assert {"step_index": 9, "terminated": False} in rows.to_arrow_table().to_pylist()
