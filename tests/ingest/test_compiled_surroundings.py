"""What robots see of their plans and of who comes near: compiled code and NumPy's, bit for bit."""

from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from restock import native
from restock.ingest.task.surroundings import (
    came_nearer,
    plan_distances_m,
    returns_on_plan,
    view_route,
)
from restock.ingest.task.task import Body, Task

compiled = pytest.mark.skipif(not native.IS_USED, reason=f"native code is {native.state()}")
pytestmark = [compiled, pytest.mark.filterwarnings("ignore::RuntimeWarning")]
TASK = Task(
    body=Body(length_m=0.7, width_m=0.5, lidar_x_m=0.2),
    actions=((0.0, 0.0), (1.0, 0.0)),
    range_max_m=8.3,
)
many = settings(max_examples=150, deadline=None)
seeds = st.integers(0, 2**32)
sizes = st.integers(0, 6)
sector_counts = st.integers(2, 20).map(lambda half: 2 * half)
spoilt = st.sampled_from([0.0, 0.0, 0.03])  # of all numbers: not a number, or infinite


def spoil(rng: np.random.Generator, share: float, *arrays: Any) -> None:
    for array in arrays:
        wrong = rng.random(array.shape) < share
        array[wrong] = rng.choice([np.nan, np.inf, -np.inf], wrong.sum())


def by_both(call: Callable[[], Any]) -> tuple[Any, Any]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(native, "IS_USED", False)
        plain = call()
    return plain, call()


def equal(plain: Any, fast: Any) -> None:
    """Not a number only where the other is not one; all else to the last bit."""
    np.testing.assert_array_equal(plain, fast, strict=True)


def plans_of(rng: np.random.Generator, count: int, points: int) -> Any:
    """Wandering plans, some on a grid, where much is equally near, and some that end early."""
    plans = rng.normal(size=(count, points, 2)).cumsum(axis=1)
    on_grid = rng.random(count) < 0.4
    plans[on_grid] = np.round(plans[on_grid])
    for plan in plans:
        plan[rng.integers(1, points + 1) :] = plan[-1]
    return plans


@many
@given(seeds, sizes, st.integers(2, 40), spoilt)
def test_a_route_is_seen_alike(seed: int, count: int, points: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    plans, pose = plans_of(rng, count, points), np.round(rng.normal(size=(3, count)) * 3, 1)
    spoil(rng, share, plans, pose)
    plain, fast = by_both(lambda: view_route(plans, *pose, plan_distances_m(TASK)))
    equal(plain.look_ahead_m, fast.look_ahead_m)
    equal(plain.remaining_m, fast.remaining_m)
    equal(plain.offset_m, fast.offset_m)


@many
@given(seeds, sizes, sector_counts, spoilt)
def test_returns_on_a_plan_are_found_alike(seed, count, sectors, share):
    rng = np.random.default_rng(seed)
    task = msgspec.structs.replace(TASK, sectors=sectors)
    clearance, plan = rng.uniform(0, 9, (count, sectors)), plans_of(rng, count, 7)
    clearance[clearance > 8] = task.range_max_m
    spoil(rng, share, clearance, plan)
    plain, fast = by_both(lambda: returns_on_plan(task, clearance, plan))
    equal(np.array(plain), np.array(fast))
    if not share:
        assert np.isfinite(fast).all()


@many
@given(seeds, sizes, sector_counts, st.integers(1, 12), spoilt)
def test_who_came_nearer_is_found_alike(seed, count, sectors, steps, share):
    rng = np.random.default_rng(seed)
    task = msgspec.structs.replace(TASK, sectors=sectors)
    walls = rng.uniform(0.0, 5.0, (count, sectors))
    scans = []
    for step in range(steps + 1):  # the last one first: walls, of which some came nearer
        clearance = np.round(walls + step * rng.choice([0.0, 0.0, 0.2], walls.shape), 1)
        clearance[clearance > 4.5] = task.range_max_m
        one = {
            "stamp_ns": np.full(count, (1 + steps - step) * 200_000_000),
            "gyro_yaw_rate_radps": rng.choice([0.0, 0.4, -np.pi], count),
            "localised_speed_mps": rng.choice([0.0, 0.5, 1.0], count),
            "localised_lateral_mps": rng.choice([0.0, 0.1], count),
            "sector_clearance_m": clearance,
        }
        spoil(rng, share, *(column for name, column in one.items() if name != "stamp_ns"))
        scans.append(one)
    plain, fast = by_both(lambda: came_nearer(task, scans[0], scans[1:]))
    equal(plain, fast)


@pytest.mark.parametrize("name", ["view_plans", "find_returns", "find_came"])
def test_arrays_that_do_not_fit_are_refused(name: str) -> None:
    """Each argument in turn: too long, of another type, no array; none is read past its end."""
    n, points, looks, sectors, steps = 3, 5, 2, 4, 2
    shapes = {
        "view_plans": [n * points * 2, n, n, n, n, looks, n * looks * 2, n, n],
        "find_returns": [n * sectors] * 3 + [n * points * 2, n, n],
        "find_came": [
            *(n * sectors, steps * n * sectors, steps * 4 * n, n),
            *(sectors, sectors, sectors, sectors - 1, n),
        ],
    }[name]
    limits = {"view_plans": (), "find_returns": ((1.0,) * 4,), "find_came": ((1.0,) * 3,)}[name]
    call, arrays = getattr(native.compiled, name), [np.ones(length) for length in shapes]
    call(*arrays, *limits)
    if limits:
        with pytest.raises(TypeError):
            call(*arrays, limits[0][:-1])
    for place, array in enumerate(arrays):
        wrongs: list[tuple[Any, type[Exception]]] = [
            (array.astype(np.float32), TypeError),
            (None, TypeError),
        ]
        if (name, place) != ("view_plans", 5):  # as many distances as there are places for
            wrongs += [(np.ones(len(array) + 1), ValueError), (array[:0], ValueError)]
        for wrong, error in wrongs:
            with pytest.raises(error):
                call(*(wrong if each == place else one for each, one in enumerate(arrays)), *limits)
