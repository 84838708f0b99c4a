"""Distinguish sound logged rows from rows with wrong labels or wrong next observations."""

import numpy as np
import torch
from numpy.typing import NDArray

from restock.train.feed.logs import LogFidelity, Probe

SIZE, ROWS = 12, 200
CONDITIONS = ["nominal", "wheel_slip", "blocked_aisle"]


def rows(rng: np.random.Generator, level: float) -> NDArray[np.float32]:
    """Return packed rows (ROWS, 2 SIZE + 3) of a linear system at this level."""
    observation = rng.normal(level * np.linspace(0, 1, SIZE), 0.3, (ROWS, SIZE))
    action = rng.integers(0, 4, ROWS)
    following = 0.9 * observation + 0.2 * action[:, None] + rng.normal(0, 0.05, (ROWS, SIZE))
    rest = np.stack([action, rng.normal(size=ROWS), np.full(ROWS, 0.97)], axis=1)
    return np.concatenate([observation, following, rest], axis=1).astype(np.float32)


def probe(parts: list[NDArray[np.float32]]) -> Probe:
    bounds = np.cumsum([0, *map(len, parts)]).tolist()
    packed = torch.from_numpy(np.concatenate(parts))
    return Probe(packed, CONDITIONS[: len(parts)], bounds, "logs", "")


def levels(seed: int) -> list[NDArray[np.float32]]:
    rng = np.random.default_rng(seed)
    return [rows(rng, level) for level in (0.0, 2.0, -2.0)]


def test_sound_rows_agree_and_are_explained() -> None:
    logs = LogFidelity(probe(levels(0)), SIZE)
    assert all(share > 0.9 for share in logs.agreement(probe(levels(1))).values())
    assert all(rest < 0.2 for rest in logs.unexplained.values())
    assert set(logs.unexplained) == set(CONDITIONS)


def test_agreement_combines_sources() -> None:
    """Combine an evaluation with few rows of a condition and a ring that has more."""
    logs = LogFidelity(probe(levels(0)), SIZE)
    nominal, slip, blocked = levels(1)
    few = probe([nominal, slip, blocked[:40]])
    assert set(logs.agreement(few)) == {"nominal", "wheel_slip"}
    found = logs.agreement(few, probe([nominal[:60], slip[:60], blocked[40:80]]))
    assert found.keys() == set(CONDITIONS)
    assert all(share > 0.9 for share in found.values())


def test_wrong_labels_have_low_agreement() -> None:
    nominal, slip, blocked = levels(0)
    logs = LogFidelity(probe([np.concatenate([nominal[:100], blocked]), slip, nominal[100:]]), SIZE)
    found = logs.agreement(probe(levels(1)))
    assert found["blocked_aisle"] < 0.1
    assert found["wheel_slip"] > 0.9


def test_shuffled_next_observations_are_unexplained() -> None:
    nominal, slip, blocked = levels(0)
    blocked[:, SIZE : 2 * SIZE] = np.random.default_rng(2).permutation(blocked[:, SIZE : 2 * SIZE])
    found = LogFidelity(probe([nominal, slip, blocked]), SIZE).unexplained
    assert found["blocked_aisle"] > 0.9
    assert found["blocked_aisle"] > 3 * max(found["nominal"], found["wheel_slip"])


def test_conditions_with_few_rows_are_skipped() -> None:
    nominal, slip, blocked = levels(0)
    logs = LogFidelity(probe([nominal, slip, blocked[:5]]), SIZE)
    assert set(logs.unexplained) == {"nominal", "wheel_slip"}
    assert set(logs.agreement(probe(levels(1)))) == {"nominal", "wheel_slip"}
    assert logs.agreement(probe([nominal])) == {}
