"""Check floors: generated, from TOML, from occupancy maps, and several in one twin."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

import msgspec
import numpy as np
import PIL
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from packaging.version import Version
from PIL import Image
from scipy.sparse import csgraph

import restock  # noqa: F401 - registers the environment
from restock.cli import main
from restock.cli.learning.train import describe_run
from restock.errors import ConfigError
from restock.ingest.profile.profile import load_profile
from restock.train.prepare import prepare_new
from restock.train.twin.env.navigation import BlockFinder
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.floors.floor_files import (
    cells_of,
    read_floor,
    read_image,
    read_map,
    write_floor,
)
from restock.train.twin.floors.floors import (
    RECIPES,
    SPLITS,
    generate,
    layouts_of_split,
    open_floor,
    open_floors,
    seeds_of,
    split_of,
)
from restock.train.twin.floors.layout import (
    OneWay,
    Warehouse,
    default_warehouse,
    edges_of,
    within,
)
from restock.train.twin.floors.planner import Planner
from restock.train.twin.missions import KINDS
from restock.train.twin.physics.episode import EpisodeSpec, describe_floor, draw_episode

SEEDS = st.integers(0, 10_000)
SAYS_TRUNCATED = pytest.mark.skipif(
    Version(PIL.__version__) < Version("13"), reason="Pillow before 13 says it in other words"
)
KINDS_OF_FLOOR = st.sampled_from(sorted(RECIPES))


@given(seed=SEEDS, kind=KINDS_OF_FLOOR)
@settings(max_examples=20)
def test_goals_of_generated_floor_are_reachable(seed: int, kind: str) -> None:
    floor = generate(seed, RECIPES[kind])
    assert floor == generate(seed, RECIPES[kind])
    planner = Planner(floor)
    goals = {planner.cell(x, y) for x, y in floor.goals}
    starts = {planner.cell(*segment.area.center) for segment in floor.segments}
    # Under the one-way rules, all are in one strongly connected component.
    _, part = csgraph.connected_components(planner._graph, connection="strong")
    assert len({part[cell] for cell in goals | starts}) == 1
    for segment in floor.segments:
        assert segment.width_m >= RECIPES[kind].aisle_m[0] - 1e-6


def test_splits_are_disjoint() -> None:
    floors = {split: {f.hash for f in open_floors(f"generated:{split}:40")} for split in SPLITS}
    assert all(len(hashes) == 40 for hashes in floors.values())
    assert not floors["train"] & floors["test"]
    assert not floors["train"] & floors["validation"]
    assert not floors["validation"] & floors["test"]
    assert layouts_of_split("default, generated:train:64", "test") == "default,generated:test"
    shares = [sum(split_of(seed) == split for seed in range(2000)) / 2000 for split in SPLITS]
    np.testing.assert_allclose(shares, [0.7, 0.1, 0.2], atol=0.05)
    assert list(islice(seeds_of("test"), 3)) == [s for s in range(30) if split_of(s) == "test"][:3]


@given(seed=SEEDS, kind=KINDS_OF_FLOOR)
@settings(max_examples=6)
def test_floor_round_trips_through_toml(seed, kind, tmp_path_factory):
    folder = tmp_path_factory.mktemp("floor")
    floor = replace(generate(seed, RECIPES[kind]), map_origin=(-3.0, 2.0, 0.5))
    write_floor(floor, folder / "floor.toml")
    assert read_floor(folder / "floor.toml") == floor


@pytest.mark.parametrize("mode", ["trinary", "scale", "raw"])
@pytest.mark.parametrize("negate", [0, 1])
def test_map_modes_give_equal_free_space(tmp_path, mode, negate):
    free = np.zeros((80, 120), np.bool_)
    free[10:70, 10:110] = True
    free[30:50, 40:80] = False
    if mode == "raw":
        pixels = np.where(free, 0, 100)
        pixels[0, 0] = 255  # unknown
    else:
        pixels = np.where(free, 254, 0)
        pixels[0, 0] = 205
        pixels = 255 - pixels if negate else pixels
    Image.fromarray(pixels.astype(np.uint8)).save(tmp_path / "map.pgm")
    (tmp_path / "map.yaml").write_text(
        f"image: map.pgm\nresolution: 0.1\norigin: [1.0, 2.0, 0.0]\nmode: {mode}\n"
        f"negate: {negate}\nfree_thresh: 0.25\noccupied_thresh: 0.65\n"
    )
    floor = read_map(tmp_path / "map.yaml")
    assert (floor.width_m, floor.depth_m) == (10.0, 6.0)
    np.testing.assert_array_equal(cells_of(floor, 0.1), free[10:70, 10:110][::-1].T)
    assert floor.map_origin == pytest.approx((2.0, 3.0, 0.0))


def test_rotated_map_origin_is_kept(tmp_path: Path) -> None:
    Image.fromarray(np.pad(np.full((40, 60), 254, np.uint8), 10)).save(tmp_path / "map.pgm")
    (tmp_path / "map.yaml").write_text(
        f"image: map.pgm\nresolution: 0.1\norigin: [5.0, 0.0, {np.pi / 2}]\n"
    )
    floor = read_map(tmp_path / "map.yaml")
    # The image's x is the map's y: the floor's corner, 1 m and 1 m into the image, is at (4, 1).
    assert floor.map_origin == pytest.approx((4.0, 1.0, np.pi / 2), abs=1e-9)


def test_ascii_and_16_bit_greymaps_with_comments_are_read(tmp_path: Path) -> None:
    (tmp_path / "a.pgm").write_text("P2 # plain\n# a comment\n3 2\n9\n0 9 9\n0 0 # end\n9\n")
    np.testing.assert_array_equal(read_image(tmp_path / "a.pgm")[0], [[0, 1, 1], [0, 0, 1]])
    (tmp_path / "b.pgm").write_bytes(b"P5\n2 1\n65535\n\x00\x00\xff\xff")
    np.testing.assert_array_equal(read_image(tmp_path / "b.pgm")[0], [[0, 1]])


@pytest.mark.parametrize(
    ("data", "message"),
    [
        pytest.param(b"P5\n4 4\n255\nab", "truncated", marks=SAYS_TRUNCATED),
        (b"P5\n99999 99999\n255\n", "exceeds limit"),
        (b"P5\n7900 7900\n255\n", "7,900 x 7,900 pixels"),  # rejected by the header
        (b"P2\n2 1\n9\n1 10", "too large"),
        (b"P5\n4 4\n255\n" + bytes(16), "no free place"),
    ],
)
def test_invalid_map_image_is_rejected(tmp_path: Path, data: bytes, message: str) -> None:
    (tmp_path / "map.pgm").write_bytes(data)
    (tmp_path / "map.yaml").write_text("image: map.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n")
    with pytest.raises(ConfigError, match=message):
        read_map(tmp_path / "map.yaml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("resolution: 0.05\norigin: [0, 0, 0]\n", "image"),
        ("image: a.pgm\nresolution: -1\norigin: [0, 0, 0]\n", "resolution"),
        ("image: a.pgm\nresolution: 0.05\norigin: [1.0e+300, 0, 0]\n", "origin"),
        ("image: ../a.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n", "outside its folder"),
        ("image: gone.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n", "cannot be read"),
        ("image: [\n", "YAML"),
    ],
)
def test_invalid_map_yaml_is_rejected(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "map.yaml").write_text(text)
    with pytest.raises(ConfigError, match=message):
        read_map(tmp_path / "map.yaml")


@pytest.mark.parametrize(
    "text",
    [
        *("generated:", "generated:-1", "generated:train:0", "generated:holdout", "hall"),
        *("no.toml", "no.yaml", "default,default", "generated:" + "9" * 30),
    ],
)
def test_invalid_layout_is_rejected(text: str) -> None:
    with pytest.raises(ConfigError):
        open_floors(text)
    with pytest.raises(ConfigError):
        open_floor("generated:train")


def test_floor_of_racks_gets_aisles_and_goals(tmp_path: Path) -> None:
    known = default_warehouse()
    racks = [[r.x_min, r.y_min, r.x_max, r.y_max] for r in known.racks]
    (tmp_path / "hall.toml").write_text(f"width_m = 12.0\ndepth_m = 10.0\nracks = {racks}\n")
    floor = read_floor(tmp_path / "hall.toml")
    assert len(floor.segments) == len(known.segments)
    assert floor.name == "hall.toml"
    for kind in KINDS:
        draw_episode(EpisodeSpec(kind, 3), floor, Planner(floor))
    (tmp_path / "hall.toml").write_text("width_m = 12.0\ndepth_m = 1e9\nracks = []\n")
    with pytest.raises(ConfigError, match="outside 1 to 60 m"):
        read_floor(tmp_path / "hall.toml")
    (tmp_path / "hall.toml").write_text("width_m = 12.0\ndepth = 10.0\nracks = []\n")
    with pytest.raises(ConfigError, match="depth"):
        read_floor(tmp_path / "hall.toml")


def test_conditions_that_do_not_fit_the_floor_are_rejected(tmp_path, capsys, shell):
    hall = tmp_path / "hall.toml"
    hall.write_text("width_m = 12.0\ndepth_m = 10.0\nracks = [[5.8, 0.0, 6.2, 10.0]]\n")
    message = "has no room for episodes of blocked_aisle"
    with pytest.raises(ConfigError, match=message):
        WarehouseVectorEnv(2, layouts=str(hall))
    # A condition with share 0 is still evaluated.
    shares = "env.conditions={nominal=1, blocked_aisle=0}"
    with pytest.raises(ConfigError, match=message):
        prepare_new(tmp_path / "run", None, None, [f"env.layouts={hall}", shares])
    with pytest.raises(ConfigError, match="'ice'"):
        prepare_new(tmp_path / "run", None, None, ["env.conditions={nominal=0.5, ice=0.2}"])
    record = ["twin", "record", "--out", str(tmp_path / "a.mcap"), "--missions", "1"]
    assert main([*record, "--layouts", str(hall)]) != 0
    assert message in capsys.readouterr().err
    # Without those conditions the floor is accepted, and unreachable goals are reported.
    assert "60 of 120 goals cannot be reached" in shell.err(
        *record, "--layouts", hall, "--conditions", "nominal=1", code=0
    )
    prepared = prepare_new(
        tmp_path / "run", None, None, [f"env.layouts={hall}", "env.conditions={nominal=1}"]
    )
    assert "60 of 120 goals cannot be reached" in describe_run(prepared)
    assert describe_floor(read_floor(hall))["unreachable_goals"] == 60


def test_one_way_rules_reroute_without_trapping() -> None:
    floor = default_warehouse()
    lane = floor.segments[2].area  # aisle 2, west
    start, goal = (lane.x_max - 0.5, lane.center[1]), (lane.x_min - 1.0, lane.center[1])
    free = Planner(floor).plan(*start, goal)
    ruled = Planner(replace(floor, one_way=(OneWay(lane, "east"),)))
    around = ruled.plan(*start, goal)
    length = [float(np.hypot(*np.diff(way, axis=0).T).sum()) for way in (free, around)]
    assert length[1] > length[0] + 3.0
    inside = within(edges_of([lane]), *around.T)[:, 0]
    assert not any(
        a and b and after[0] < before[0] - 1e-6
        for a, b, before, after in zip(inside, inside[1:], around, around[1:], strict=False)
    )
    # The lane is closed east of the robot, so the plan goes west, against the rule.
    middle = (lane.x_min + 0.6, lane.center[1])
    out = ruled.plan(*middle, (lane.x_max + 1.0, lane.center[1]), [(2, 5)])
    assert out[:, 0].min() < lane.x_min
    shut = np.array([[lane.x_max - 0.5, lane.center[1], 0.0]])  # a box across the lane
    seen = ruled.plan_around(*middle, (lane.x_max + 1.0, lane.center[1]), shut, (0.2, 1.0))
    assert seen is not None
    assert seen[:, 0].min() < lane.x_min


def test_block_in_north_south_aisle_is_found() -> None:
    floor = generate(3)
    area = floor.segments[1].area
    assert floor.segments[1].along == "y"
    finder = BlockFinder([floor], 1)
    pose = np.array([[area.center[0], area.y_min + 0.2, np.pi / 2]])
    half = area.half_size[0] - 0.15
    across = np.linspace(-half, half, 9)
    hits = np.stack([area.center[0] + across, np.full(9, area.y_min + 1.2)], axis=-1)[None]
    arguments = (np.ones((1, 9), np.bool_), np.array([1.0]), np.array([True]))
    looks = [finder.update(np.array([0]), pose, hits, *arguments) for _ in range(3)]
    assert [len(blocks) for blocks in looks] == [0, 0, 1]
    (_, (segment, step)) = looks[2][0]
    assert segment == 1
    around = Planner(floor).plan(*pose[0, :2], (area.center[0], area.y_max + 0.8), [(1, step)])
    near = np.abs(around[:, 1] - (area.y_min + 1.5)) < 0.15
    assert not (near & (around[:, 0] > area.x_min) & (around[:, 0] < area.x_max)).any()


def _drive(env: WarehouseVectorEnv, specs: list[EpisodeSpec], steps: int) -> np.ndarray:
    env.set_episodes(specs)
    seen = [env.reset(seed=5)[0]]
    rng = np.random.default_rng(0)
    for action in rng.integers(10, size=(steps, len(specs))):
        seen.append(env.step(action)[0])
    return np.array(seen)


@pytest.mark.long
def test_episode_does_not_depend_on_other_floors() -> None:
    floors = open_floors("default,generated:train:3,narrow:1")
    # Episodes after a bump are drawn from the available floors.
    task = msgspec.structs.replace(load_profile("warehouse_amr").task, bump_terminates=False)

    def warehouse(envs: int, floors: Sequence[Warehouse], nthread: int = 1) -> WarehouseVectorEnv:
        return WarehouseVectorEnv(envs, layouts=tuple(floors), task=task, nthread=nthread)

    specs = [EpisodeSpec(KINDS[i % 4], 70 + i, layout=floors[i % 5].name) for i in range(10)]
    among = _drive(warehouse(10, floors), specs, 40)
    threads = warehouse(10, floors[::-1], nthread=2)
    np.testing.assert_array_equal(_drive(threads, specs, 40), among)
    for index in (0, 1, 4):
        alone = _drive(warehouse(2, floors[index : index + 1]), specs[index::5], 0)
        np.testing.assert_array_equal(alone[0], among[0, index::5])
    one, many = warehouse(10, floors[2:3]), warehouse(10, floors)
    there = [replace_layout(spec, floors[2].name) for spec in specs]
    np.testing.assert_array_equal(_drive(one, there, 40), _drive(many, there, 40))


def replace_layout(spec: EpisodeSpec, layout: str) -> EpisodeSpec:
    return EpisodeSpec(spec.condition, spec.seed, layout=layout)


def test_episodes_use_all_floors_and_info_names_them() -> None:
    env = WarehouseVectorEnv(64, layouts="generated:train:4", conditions={"nominal": 1.0})
    _, info = env.reset(seed=1)
    assert set(info["layout"]) == {floor.name for floor in env.floors}
    for index in range(64):
        floor: Warehouse = info["floor"][index]
        assert floor.name == info["layout"][index] == env.floor_of(index).name
    with pytest.raises(ConfigError, match="is not among the environment's 4"):
        _drive(env, [EpisodeSpec("nominal", 1, layout="default")] * 64, 0)


def test_profile_and_warehouse_zones_match() -> None:
    zones = {zone.name: zone.box_m for zone in load_profile("warehouse_amr").zones}
    built = default_warehouse().zones
    assert zones.keys() == built.keys()
    for name, rect in built.items():
        edges = (rect.x_min, rect.y_min, rect.x_max, rect.y_max)
        np.testing.assert_allclose(zones[name], edges, atol=1e-9, err_msg=name)


def test_racks_fill_space_outside_aisles() -> None:
    floor = default_warehouse()
    places = np.random.default_rng(1).uniform((0, 0), (floor.width_m, floor.depth_m), (400, 2)).T
    aisles = [segment.area for segment in floor.segments]
    ways = edges_of([*aisles, *(zone for _, zone in floor.cross_zones)])
    in_rack = within(edges_of(floor.racks), *places).any(axis=1)
    assert (in_rack == ~within(ways, *places).any(axis=1)).all()


def test_point_belongs_to_its_aisle_segment() -> None:
    floor = default_warehouse()
    middles = np.array([segment.area.center for segment in floor.segments])
    segment = floor.segment_of(middles[:, 0], middles[:, 1])
    assert segment.tolist() == list(range(len(floor.segments)))
    assert floor.segment_of(np.array([1.1]), np.array([5.0]))[0] == -1  # in a cross-aisle
