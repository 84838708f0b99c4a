"""Views of plans and approaching objects: compiled code equals NumPy's bit for bit."""

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
spoilt = st.sampled_from([0.0, 0.0, 0.03])  # share of numbers replaced by NaN or infinity


def put_nonfinite(rng: np.random.Generator, share: float, *arrays: Any) -> None:
    for array in arrays:
        wrong = rng.random(array.shape) < share
        array[wrong] = rng.choice([np.nan, np.inf, -np.inf], wrong.sum())


def run_both(call: Callable[[], Any]) -> tuple[Any, Any]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(native, "IS_USED", False)
        plain = call()
    return plain, call()


def assert_identical(plain: Any, fast: Any) -> None:
    """Assert equality to the last bit, with NaN in the same places."""
    np.testing.assert_array_equal(plain, fast, strict=True)


def random_plans(rng: np.random.Generator, count: int, points: int) -> Any:
    """Return random-walk plans, some on a grid (many equal distances), some that end early."""
    plans = rng.normal(size=(count, points, 2)).cumsum(axis=1)
    on_grid = rng.random(count) < 0.4
    plans[on_grid] = np.round(plans[on_grid])
    for plan in plans:
        plan[rng.integers(1, points + 1) :] = plan[-1]
    return plans


@many
@given(seeds, sizes, st.integers(2, 40), spoilt)
def test_route_view_equals_numpy(seed: int, count: int, points: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    plans, pose = random_plans(rng, count, points), np.round(rng.normal(size=(3, count)) * 3, 1)
    put_nonfinite(rng, share, plans, pose)
    plain, fast = run_both(lambda: view_route(plans, *pose, plan_distances_m(TASK)))
    assert_identical(plain.look_ahead_m, fast.look_ahead_m)
    assert_identical(plain.remaining_m, fast.remaining_m)
    assert_identical(plain.offset_m, fast.offset_m)


@many
@given(seeds, sizes, sector_counts, spoilt)
def test_returns_on_plan_equal_numpy(seed, count, sectors, share):
    rng = np.random.default_rng(seed)
    task = msgspec.structs.replace(TASK, sectors=sectors)
    clearance, plan = rng.uniform(0, 9, (count, sectors)), random_plans(rng, count, 7)
    clearance[clearance > 8] = task.range_max_m
    put_nonfinite(rng, share, clearance, plan)
    plain, fast = run_both(lambda: returns_on_plan(task, clearance, plan))
    assert_identical(np.array(plain), np.array(fast))
    if not share:
        assert np.isfinite(fast).all()


@many
@given(seeds, sizes, sector_counts, st.integers(1, 12), spoilt)
def test_approach_detection_equals_numpy(seed, count, sectors, steps, share):
    rng = np.random.default_rng(seed)
    task = msgspec.structs.replace(TASK, sectors=sectors)
    walls = rng.uniform(0.0, 5.0, (count, sectors))
    scans = []
    for step in range(steps + 1):  # latest scan first: walls, parts of which came nearer
        clearance = np.round(walls + step * rng.choice([0.0, 0.0, 0.2], walls.shape), 1)
        clearance[clearance > 4.5] = task.range_max_m
        scan = {
            "stamp_ns": np.full(count, (1 + steps - step) * 200_000_000),
            "gyro_yaw_rate_radps": rng.choice([0.0, 0.4, -np.pi], count),
            "localised_speed_mps": rng.choice([0.0, 0.5, 1.0], count),
            "localised_lateral_mps": rng.choice([0.0, 0.1], count),
            "sector_clearance_m": clearance,
        }
        put_nonfinite(rng, share, *(column for name, column in scan.items() if name != "stamp_ns"))
        scans.append(scan)
    plain, fast = run_both(lambda: came_nearer(task, scans[0], scans[1:]))
    assert_identical(plain, fast)


@pytest.mark.parametrize("name", ["view_plans", "find_returns", "find_came"])
def test_mismatched_arrays_are_rejected(name: str) -> None:
    """Each argument in turn is too long, of another type or no array; none is read past its end."""
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
        invalid: list[tuple[Any, type[Exception]]] = [
            (array.astype(np.float32), TypeError),
            (None, TypeError),
        ]
        if (name, place) != ("view_plans", 5):  # the number of distances may differ there
            invalid += [(np.ones(len(array) + 1), ValueError), (array[:0], ValueError)]
        for wrong, error in invalid:
            with pytest.raises(error):
                call(*(wrong if each == place else one for each, one in enumerate(arrays)), *limits)
