"""The warehouse: its geometry, and that the profile's zones are its aisles and cross-aisles."""

import numpy as np

from restock.ingest.profile.profile import load_profile
from restock.train.twin.floors.layout import default_warehouse


def test_the_profile_names_the_same_zones_as_the_warehouse() -> None:
    zones = {zone.name: zone.box_m for zone in load_profile("warehouse_amr").zones}
    built = default_warehouse().zones
    assert zones.keys() == built.keys()
    for name, rect in built.items():
        edges = (rect.x_min, rect.y_min, rect.x_max, rect.y_max)
        np.testing.assert_allclose(zones[name], edges, atol=1e-9, err_msg=name)


def test_racks_fill_exactly_what_aisles_and_cross_aisles_leave() -> None:
    floor = default_warehouse()
    rng = np.random.default_rng(1)
    for x, y in rng.uniform((0, 0), (floor.width_m, floor.depth_m), (400, 2)):
        in_aisle = any(segment.area.contains(x, y) for segment in floor.segments)
        in_cross = any(zone.contains(x, y) for _, zone in floor.cross_zones)
        in_rack = any(rack.contains(x, y) for rack in floor.racks)
        assert in_rack == (not in_aisle and not in_cross)


def test_a_point_belongs_to_its_aisle_segment() -> None:
    floor = default_warehouse()
    middles = np.array([segment.area.center for segment in floor.segments])
    segment = floor.segment_of(middles[:, 0], middles[:, 1])
    assert segment.tolist() == list(range(len(floor.segments)))
    assert floor.segment_of(np.array([1.1]), np.array([5.0]))[0] == -1  # in a cross-aisle
