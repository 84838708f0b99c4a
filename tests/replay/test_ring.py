"""The fresh ring: n-step rows against a naive oracle, eviction, labels, resume."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.states import leaves, through_json

from restock.errors import MixtureError
from restock.replay.sampling.ring import FreshRing

SIZE = 3
CONDITIONS = ("wheel_slip", "blocked_aisle", "nominal")


@dataclass
class Drive:
    """Random steps of N environments with SAME_STEP autoreset, as the twin gives them."""

    num_envs: int
    seed: int
    steps: list[dict[str, Any]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)
        self.observation = self.fresh()

    def fresh(self) -> np.ndarray:
        return self.rng.normal(size=(self.num_envs, SIZE)).astype(np.float32)

    def step(self) -> dict[str, Any]:
        ended = self.rng.random(self.num_envs) < 0.25
        terminated = ended & (self.rng.random(self.num_envs) < 0.5)
        after, after_reset = self.fresh(), self.fresh()
        step = {
            "observation": self.observation.copy(),
            "action": self.rng.integers(0, 9, self.num_envs),
            "reward": self.rng.normal(size=self.num_envs).astype(np.float32),
            "terminated": terminated,
            "truncated": ended & ~terminated,
            "next_observation": after,
        }
        self.observation = np.where(ended[:, None], after_reset, after)
        self.steps.append(step)
        return step


def oracle(steps: list[dict[str, Any]], discount: float, n_step: int) -> dict[tuple[int, int], Any]:
    """Return the packed rows of all complete steps by (env, first step)."""
    found = {}
    for env in range(len(steps[0]["action"])):
        for first in range(len(steps)):
            total, horizon, complete, terminal = 0.0, 0, False, False
            for step in steps[first : first + n_step]:
                total += discount**horizon * float(step["reward"][env])
                horizon += 1
                terminal = bool(step["terminated"][env])
                if terminal or step["truncated"][env]:
                    complete = True
                    break
            if complete or horizon == n_step:
                last = steps[first + horizon - 1]
                found[env, first] = np.concatenate(
                    [
                        steps[first]["observation"][env],
                        last["next_observation"][env],
                        [steps[first]["action"][env], total, discount**horizon * (not terminal)],
                    ]
                )
    return found


@settings(max_examples=60)
@given(
    num_envs=st.integers(1, 4),
    n_step=st.integers(1, 5),
    steps=st.integers(1, 25),
    seed=st.integers(0, 2**32),
)
def test_rows_match_naive_n_step_oracle(num_envs, n_step, steps, seed):
    ring = FreshRing(500, num_envs, SIZE, discount=0.9, n_step=n_step)
    drive = Drive(num_envs, seed)
    keys = []
    for index in range(steps):
        step = drive.step()
        keys.append(ring.append(**step, env_step=index * num_envs, gradient_step=index // 4))
    expected = oracle(drive.steps, 0.9, n_step)
    assert len(ring) == len(expected)
    # A row is found by its episode and its step in it.
    began: dict[int, int] = {}
    for index, row_keys in enumerate(keys):
        for key in row_keys.tolist():
            began.setdefault(key, index)
    env_of = {key: env for row_keys in keys for env, key in enumerate(row_keys.tolist())}
    for slot in range(len(ring)):
        key = int(ring.meta["episode"][slot])
        first = began[key] + int(ring.meta["episode_step"][slot])
        np.testing.assert_allclose(
            ring.rows[slot], expected.pop((env_of[key], first)), rtol=1e-5, atol=1e-5
        )
        assert ring.meta["env_step"][slot] == first * num_envs
        assert ring.meta["gradient_step"][slot] == first // 4
    assert not expected


def make_ring(
    capacity: int = 60, seed: int = 0, num_envs: int = 2, **reserved: int
) -> tuple[FreshRing, Drive]:
    """Return an empty ring and its environments."""
    ring = FreshRing(
        capacity, num_envs, SIZE, discount=0.9, n_step=3, conditions=CONDITIONS, reserved=reserved
    )
    return ring, Drive(num_envs, seed)


def advance(ring: FreshRing, drive: Drive, steps: int) -> None:
    """Drive some steps; label ended episodes by the parity of their steps."""
    for _ in range(steps):
        step = drive.step()
        keys = ring.append(**step, env_step=len(drive.steps), gradient_step=0, policy_version=7)
        for key in keys[step["terminated"] | step["truncated"]].tolist():
            ring.set_labels(key, np.where(np.arange(500) % 2 == 0, 2, key % 2))


def test_strata_follow_labels_and_eviction():
    ring, drive = make_ring(30)
    advance(ring, drive, 200)
    ended = ~np.isin(ring.meta["episode"][: len(ring)], ring.episode_key)
    codes = ring.condition(np.arange(len(ring)))
    assert (codes[ended] >= 0).all()
    assert (codes[~ended] == -1).all()
    expected = np.where(
        ring.meta["episode_step"][ended] % 2 == 0, 2, ring.meta["episode"][ended] % 2
    )
    np.testing.assert_array_equal(codes[ended], expected)
    for code in range(3):
        assert sorted(ring.by_condition.members(code)) == np.flatnonzero(codes == code).tolist()


@pytest.mark.parametrize("steps", [9, 150])  # before and after the ring is full
@pytest.mark.parametrize("reserved", [{}, {"wheel_slip": 20}])
def test_restored_ring_continues_exactly(steps, reserved):
    ring, drive = make_ring(seed=5, **reserved)
    label_rarely(ring, drive, steps)
    other, _ = make_ring(seed=5, **reserved)
    other.load_state_dict(through_json(ring.state_dict()))
    for one in (ring, other):
        label_rarely(one, Drive(2, 11), 200)
    pairs = zip(leaves(ring.state_dict()), leaves(other.state_dict()), strict=True)
    for (path, value), (same_path, same) in pairs:
        assert path == same_path
        np.testing.assert_array_equal(value, same, err_msg=path)
    rngs = [np.random.default_rng(9), np.random.default_rng(9)]
    for _ in range(5):
        one, two = (r.sample(10, rng) for r, rng in zip((ring, other), rngs, strict=True))
        np.testing.assert_array_equal(one, two)


def test_invalid_labels_are_refused():
    ring = FreshRing(50, 1, SIZE, discount=0.9, conditions=CONDITIONS)
    drive = Drive(1, 0)
    key = -1
    for index in range(3):
        step = drive.step() | {"terminated": np.array([index == 2]), "truncated": np.array([False])}
        key = int(ring.append(**step, env_step=0, gradient_step=0)[0])
    for labels, problem in (([0, 1, 3], "name no condition"), ([0, 1], "2 labels")):
        with pytest.raises(MixtureError, match=problem):
            ring.set_labels(key, np.array(labels))


def label_rarely(ring: FreshRing, drive: Drive, steps: int) -> None:
    """Drive some steps; label one episode in ten as wheel slip and all others as nominal."""
    for _ in range(steps):
        step = drive.step()
        keys = ring.append(**step, env_step=len(drive.steps), gradient_step=0)
        for key in keys[step["terminated"] | step["truncated"]].tolist():
            ring.set_labels(key, np.full(500, 0 if key % 10 == 0 else 2))


def test_reserved_rare_rows_are_not_evicted():
    plain, drive = make_ring(seed=3)
    label_rarely(plain, drive, 1500)
    kept, drive = make_ring(seed=3, wheel_slip=25, blocked_aisle=10)
    label_rarely(kept, drive, 1500)
    assert plain.by_condition.counts[0] < 15
    assert 25 <= kept.by_condition.counts[0] <= 60
    # Unused reserves serve all conditions; nominal rows are the newest.
    assert kept.by_condition.counts[2] >= 20
    newest = np.sort(kept.meta["env_step"][kept.by_condition.members(2)])[-10:]
    assert newest.min() > len(drive.steps) - 40
    # The oldest rare rows were evicted first, too.
    slips = kept.meta["env_step"][kept.by_condition.members(0)]
    assert slips.min() > 100


@settings(max_examples=60)
@given(
    capacity=st.integers(12, 80),
    steps=st.integers(1, 120),
    parts=st.tuples(st.integers(0, 4), st.integers(0, 4), st.integers(0, 4)),
    seed=st.integers(0, 2**32),
)
def test_ring_with_reserves_stays_consistent(capacity, steps, parts, seed):
    reserved = {
        name: part * capacity // max(sum(parts), 1)
        for name, part in zip(CONDITIONS, parts, strict=True)
    }
    ring, drive = make_ring(capacity, seed=seed, **reserved)
    advance(ring, drive, steps)
    size = len(ring)
    assert size == min(ring.appended, capacity)
    codes = ring.condition(np.arange(size))
    for code in range(3):
        assert sorted(ring.by_condition.members(code)) == np.flatnonzero(codes == code).tolist()
    # Every row is a distinct step, unchanged since it was appended.
    key = (ring.meta["episode"][:size] << 20) + ring.meta["episode_step"][:size]
    assert len(np.unique(key)) == size
    expected = oracle(drive.steps, 0.9, 3)
    at = {tuple(np.float32(row)): place for place, row in expected.items()}
    for slot in range(size):
        _, first = at[tuple(ring.rows[slot])]
        assert ring.meta["env_step"][slot] == first + 1


@pytest.mark.parametrize("reserved", [{"wheel_slip": 40, "nominal": 30}, {"unheard_of": 1}])
def test_invalid_reserves_are_refused(reserved):
    with pytest.raises(MixtureError, match="cannot be reserved"):
        make_ring(60, **reserved)


@pytest.mark.parametrize("other", [{"capacity": 61}, {"wheel_slip": 20}])
def test_state_of_other_ring_is_refused(other):
    ring, _ = make_ring(60, wheel_slip=40)
    with pytest.raises(MixtureError, match=r"another shape|reserved"):
        make_ring(**other)[0].load_state_dict(ring.state_dict())
