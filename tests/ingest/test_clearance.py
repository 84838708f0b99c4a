"""Scans to clearance while they are read: each message by itself, whatever comes with it."""

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from restock.errors import RecordingError
from restock.ingest.decoding.columns import FieldColumn, Ragged, offsets_of, take
from restock.ingest.profile.profile import load_profile
from restock.ingest.profile.tables import Input
from restock.ingest.steps import needs
from restock.ingest.steps.needs import BEAMS, BLIND, SECTORS, UNAIMED, scan_reduction
from restock.ingest.task.surroundings import SectorMap

TASK = load_profile("warehouse_amr").task
FIELDS = {
    "ranges_m": "ranges",
    "angle_min_rad": "angle_min",
    "angle_increment_rad": "angle_increment",
}
SCAN = Input("/scan", "sensor_msgs/msg/LaserScan", FIELDS)
REDUCE = scan_reduction(TASK, SCAN)


def scans(beams: list[int], firsts: list[float], seed: int) -> dict[str, FieldColumn]:
    rng = np.random.default_rng(seed)
    ranges = rng.uniform(-1, 8, sum(beams)).astype(np.float32)
    ranges[rng.random(len(ranges)) < 0.2] = np.inf
    ranges[rng.random(len(ranges)) < 0.1] = np.nan
    return {
        "ranges": Ragged(ranges, offsets_of(np.array(beams, np.int64))),
        "angle_min": np.array(firsts, np.float32),
        "angle_increment": np.full(len(beams), 0.05, np.float32),
    }


@settings(max_examples=60)
@given(
    st.lists(
        st.tuples(st.sampled_from([0, 1, 9, 120]), st.sampled_from([-3.1, 0.0, np.nan])),
        min_size=1,
        max_size=12,
    ),
    st.integers(0, 12),
    st.sampled_from([1, 100, 1 << 18]),
    st.integers(0, 99),
)
def test_a_scan_by_itself_gives_what_it_gives_among_others(kinds, at, values, seed):
    fields = scans([beams for beams, _ in kinds], [first for _, first in kinds], seed)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(needs, "_VALUES", values)
        whole = REDUCE.apply(fields)
        rows = np.arange(len(kinds))
        parts = [
            REDUCE.apply({name: take(column, some) for name, column in fields.items()})
            for some in (rows[:at], rows[at:])
        ]
    for name in (SECTORS, BEAMS, BLIND, UNAIMED):
        together = np.concatenate([np.asarray(part[name]) for part in parts])
        assert np.array_equal(np.asarray(whole[name]), together)
    for row, (beams, first) in enumerate(kinds):
        expected = np.full(TASK.sectors, TASK.range_max_m)
        blind = beams > 0 and np.isfinite(first)
        if beams and np.isfinite(first):
            bearings = float(np.float32(first)) + float(np.float32(0.05)) * np.arange(beams)
            sectors = SectorMap.build(bearings, TASK.sectors, TASK.body)
            ranges = fields["ranges"]
            assert isinstance(ranges, Ragged)
            one = np.asarray(ranges[row])[None]
            expected = sectors.clearance(one, TASK.range_min_m, TASK.range_max_m)[0]
            blind = not (one >= TASK.range_min_m).any()
        assert np.array_equal(np.asarray(whole[SECTORS])[row], expected)
        assert np.asarray(whole[BEAMS])[row] == beams
        assert np.asarray(whole[BLIND])[row] == blind
        assert np.asarray(whole[UNAIMED])[row] == (beams > 0 and np.isnan(first))


def test_an_angle_that_is_no_number_is_named() -> None:
    fields = scans([30], [-3.0], 4)
    with pytest.raises(RecordingError, match="'angle_min' of /scan is not one number per message"):
        REDUCE.apply({**fields, "angle_min": fields["ranges"]})


def test_the_last_angle_says_what_the_increment_says() -> None:
    """As of foxglove.LaserScan, which has no increment."""
    fields = scans([120, 9, 1, 0], [-3.1, 0.0, -3.1, 0.0], seed=3)
    first, step = (
        np.asarray(fields[name], np.float64) for name in ("angle_min", "angle_increment")
    )
    ends = {"start": first, "end": first + step * np.array([119, 8, 0, 0])}
    by_last = {"ranges_m": "ranges", "angle_min_rad": "start", "angle_max_rad": "end"}
    source = msgspec.structs.replace(SCAN, fields=by_last)
    found = scan_reduction(TASK, source).apply({"ranges": fields["ranges"], **ends})
    expected = REDUCE.apply(fields | {"angle_min": first, "angle_increment": step})
    for name in (SECTORS, BEAMS, BLIND, UNAIMED):
        assert np.allclose(np.asarray(found[name]), np.asarray(expected[name])), name
