"""The README's picture: the twin's robot in two of its situations, and what a batch is made of.

    python benchmarks/front_picture.py [--out docs/front.png]

The robot before a person and before a blocked aisle, as the planner comes to them in the twin; and
the shares of the conditions in `sample_logs/` and in a batch of the mixture `coverage`, as
`restock mix --dry-run` gives them.

The camera is MuJoCo's renderer off screen, over EGL, with or without a GPU. Objects (boxes,
cylinders, spheres and capsules) are drawn from the environment's state, not from the physics model:
so racks have shelves and people have heads.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import altair as alt
import mujoco
import numpy as np
import vl_convert
from gymnasium.vector import AutoresetMode
from harness import run_restock
from numpy.typing import NDArray
from PIL import Image

from restock.cli import main as restock
from restock.train.twin.floors.layout import (
    FORKLIFT_HALF_M,
    PALLET_HALF_M,
    PARKED_M,
    PEOPLE,
    Rect,
    Warehouse,
)
from restock.train.twin.physics.model import RACK_HALF_HEIGHT_M, building_boxes
from restock.train.twin.physics.robot_model import RobotModel
from restock.twin import PlannerFollower, WarehouseVectorEnv

HEIGHT_PX, SCENE_PX, CHART_PX, GAP_PX = 330, 440, 500, 10
# Where what a scene shows must be: bearing, and from and to which distance.
AHEAD = {"near_collision": (0.35, 1.6, 2.3), "blocked_aisle": (0.15, 1.8, 3.0)}
SEEDS = 60  # missions that are looked through
IN_LOGS, IN_BATCH = "in the logs", "in a batch"
COLOURS = ["#94a3b8", "#0f766e"]
REPOSITORY = Path(__file__).parents[1]


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=REPOSITORY / "docs" / "front.png")
    options = parser.parse_args()
    parts = [scene("near_collision"), scene("blocked_aisle"), shelves()]
    picture = Image.new(
        "RGB", (sum(p.width for p in parts) + GAP_PX * (len(parts) - 1), HEIGHT_PX), "white"
    )
    left = 0
    for part in parts:
        picture.paste(part, (left, 0))
        left += part.width + GAP_PX
    picture.quantize(128).save(options.out, optimize=True)
    print(f"wrote {options.out}: {picture.width} x {picture.height} pixels")
    return 0


def scene(kind: str) -> Image.Image:
    """Return the first moment in which what the kind is named for is close ahead of the robot."""
    for seed in range(SEEDS):
        env = WarehouseVectorEnv(1, conditions={kind: 1.0}, autoreset_mode=AutoresetMode.DISABLED)
        observation, _ = env.reset(seed=seed)
        planner, over = PlannerFollower(), False
        while not over:
            if ahead(env, kind):
                camera = Camera(SCENE_PX, HEIGHT_PX)
                frame = Image.fromarray(camera.frame(env, 0))
                camera.close()
                env.close()
                return frame
            action, _ = planner.act(env, observation)
            observation, _, terminated, truncated, _ = env.step(action)
            over = bool(terminated[0] or truncated[0])
        env.close()
    raise SystemExit(f"no mission of {kind} of {SEEDS} shows it close ahead")


def ahead(env: WarehouseVectorEnv, kind: str) -> bool:
    """Return whether a person, or the pallets of a blocked aisle, are close ahead of the robot."""
    x, y, yaw = env.simulation.pose()[0]
    places = env.simulation.traffic.position_m[0]
    if kind == "blocked_aisle":
        places = env.simulation.pallets[0][:, :2]
    offset = places - np.array([x, y])
    distance = np.hypot(*offset.T)
    turn = np.arctan2(offset[:, 1], offset[:, 0]) - yaw
    bearing = np.abs((turn + np.pi) % (2 * np.pi) - np.pi)
    most_rad, least_m, most_m = AHEAD[kind]
    seen: NDArray[np.bool_] = (distance >= least_m) & (distance <= most_m) & (bearing <= most_rad)
    along = abs(np.sin(2 * yaw)) < 0.1  # in the middle of an aisle, not around a corner
    return bool(along and seen.any())


def shelves() -> Image.Image:
    """Draw the share of each condition in the sample logs and in a batch."""
    with tempfile.TemporaryDirectory() as folder:
        store = f"{folder}/store"
        run_restock(["ingest", str(REPOSITORY / "sample_logs"), "--store", store])
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            restock(["mix", store, "--mixture", "coverage", "--dry-run", "--json"])
        plan = json.loads(printed.getvalue())
    rows: list[dict[str, Any]] = [
        {"condition": line["stratum"].replace("_", " "), "where": where, "share": line[key]}
        for line in plan["strata"]
        for where, key in ((IN_LOGS, "natural_share"), (IN_BATCH, "share"))
    ]
    order = [
        row["condition"]
        for row in sorted(rows, key=lambda row: -row["share"])
        if row["where"] == IN_LOGS
    ]
    base = alt.Chart(alt.Data(values=rows)).encode(
        y=alt.Y(
            "condition:N",
            sort=order,
            title=None,
            axis=alt.Axis(ticks=False, domain=False, labelPadding=8),
        ),
        yOffset=alt.YOffset("where:N", sort=[IN_LOGS, IN_BATCH]),
        x=alt.X("share:Q", title=None, axis=None, scale=alt.Scale(domain=[0, 0.85])),
    )
    colour = alt.Color(
        "where:N",
        sort=[IN_LOGS, IN_BATCH],
        scale=alt.Scale(domain=[IN_LOGS, IN_BATCH], range=COLOURS),
        legend=alt.Legend(title=None, orient="top", symbolType="square", labelLimit=0),
    )
    chart = (base.mark_bar().encode(color=colour)) + base.mark_text(align="left", dx=6).encode(
        text=alt.Text("share:Q", format=".0%")
    )
    chart = (
        chart.properties(width=330, height=HEIGHT_PX - 50)
        .configure_view(stroke=None)
        .configure_axis(labelFontSize=16, labelLimit=0, labelColor="#1f2937")
        .configure_legend(labelFontSize=16, symbolSize=220)
        .configure_text(fontSize=16, color="#1f2937")
    )
    image = Image.open(io.BytesIO(vl_convert.vegalite_to_png(chart.to_json(), scale=1)))
    ground = Image.new("RGB", (CHART_PX, HEIGHT_PX), "white")
    image.thumbnail((CHART_PX, HEIGHT_PX))
    ground.paste(image, (CHART_PX - image.width, 0), image if image.mode == "RGBA" else None)
    return ground


GEOMS = 4000
FOV_DEG = 45.0
Place = tuple[float, float, float]
Color = tuple[float, float, float, float]
Part = tuple[Any, Place, Place, float, Color]  # shape, middle, MuJoCo's sizes, yaw, colour

_BOX, _CYLINDER, _SPHERE, _CAPSULE = (
    mujoco.mjtGeom.mjGEOM_BOX,
    mujoco.mjtGeom.mjGEOM_CYLINDER,
    mujoco.mjtGeom.mjGEOM_SPHERE,
    mujoco.mjtGeom.mjGEOM_CAPSULE,
)
WALL: Color = (0.74, 0.76, 0.79, 1)
POST: Color = (0.16, 0.27, 0.46, 1)
BEAM: Color = (0.90, 0.42, 0.10, 1)
CARTONS: tuple[Color, ...] = ((0.76, 0.60, 0.42, 1), (0.69, 0.52, 0.35, 1), (0.82, 0.68, 0.50, 1))
WOOD: Color = (0.55, 0.39, 0.22, 1)
LOAD: Color = (0.80, 0.64, 0.44, 1)
BODY: Color = (0.95, 0.50, 0.10, 1)
DARK: Color = (0.12, 0.13, 0.15, 1)
LAMP: Color = (0.30, 0.95, 0.55, 1)
TRUCK: Color = (0.98, 0.78, 0.05, 1)
STEEL: Color = (0.35, 0.37, 0.40, 1)
SKIN: Color = (0.90, 0.72, 0.58, 1)
TROUSERS: Color = (0.15, 0.20, 0.32, 1)
VESTS: tuple[Color, ...] = ((0.10, 0.35, 0.90, 1), (0.80, 0.10, 0.55, 1))  # one a person
OIL: Color = (0.10, 0.42, 0.62, 0.55)
PLAN: Color = (0.10, 0.62, 0.30, 1)
GOAL: Color = (0.10, 0.70, 0.30, 0.45)
STAGE = """
<mujoco>
  <visual>
    <global offwidth="{width}" offheight="{height}" fovy="{fov}"/>
    <headlight ambient=".45 .45 .46" diffuse=".45 .45 .45" specular="0 0 0"/>
    <map znear=".005" zfar="20"/>
  </visual>
  <statistic extent="10" center="{x} {y} 0"/>
  <asset>
    <texture name="sky" type="skybox" builtin="gradient" rgb1=".92 .94 .96" rgb2=".70 .76 .82"
      width="64" height="64"/>
    <texture name="slab" type="2d" builtin="checker" rgb1=".80 .81 .82" rgb2=".77 .78 .79"
      mark="edge" markrgb=".70 .71 .72" width="256" height="256"/>
    <material name="slab" texture="slab" texrepeat=".5 .5" texuniform="true" specular="0"/>
  </asset>
  <worldbody>
    <light directional="true" pos="{x} {y} 8" dir=".35 .2 -1" diffuse=".45 .45 .44"
      specular=".1 .1 .1" castshadow="false"/>
    <geom type="plane" pos="{x} {y} 0" size="{half_x} {half_y} .1" material="slab"/>
  </worldbody>
</mujoco>
"""


class Camera:
    """A camera behind the robot and its GL context, which renders any floor and environment."""

    def __init__(self, width: int, height: int) -> None:
        from mujoco.egl import GLContext  # here: it loads OpenGL

        self._rect = mujoco.MjrRect(0, 0, width, height)
        self._context = GLContext(width, height)
        self._context.make_current()
        self._floor: Warehouse | None = None
        self._renderer: Any = None

    def frame(self, env: WarehouseVectorEnv, index: int) -> NDArray[np.uint8]:
        """Return the camera's picture of one environment now, (H, W, 3) uint8."""
        self._context.make_current()
        floor = env.floor_of(index)
        if floor is not self._floor:
            self._build(floor)
        self._look(env, index)
        scene = self._scene
        mujoco.mjv_updateScene(
            *(self._model, self._data, self._option, None, self._camera),
            *(mujoco.mjtCatBit.mjCAT_ALL, scene),
        )
        scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        for shape, place, half, yaw, color in _parts(env, index, floor):
            if scene.ngeom == scene.maxgeom:
                break  # a floor of thousands of racks: what is listed last is not drawn
            cos, sin = np.cos(yaw), np.sin(yaw)
            mujoco.mjv_initGeom(
                scene.geoms[scene.ngeom],
                shape,
                np.array(half),
                np.array(place),
                np.array([cos, -sin, 0, sin, cos, 0, 0, 0, 1]),
                np.array(color, np.float32),
            )
            scene.ngeom += 1
        pixels = np.empty((self._rect.height, self._rect.width, 3), np.uint8)
        mujoco.mjr_render(self._rect, scene, self._renderer)
        mujoco.mjr_readPixels(pixels, None, self._rect, self._renderer)
        return np.ascontiguousarray(pixels[::-1])

    def close(self) -> None:
        """Release the GL context."""
        if self._floor is not None:
            self._context.make_current()
            self._renderer.free()
            self._floor = None
        self._context.free()

    def _build(self, floor: Warehouse) -> None:
        if self._floor is not None:
            self._renderer.free()
        x, y = floor.width_m / 2, floor.depth_m / 2
        text = STAGE.format(
            width=self._rect.width,
            height=self._rect.height,
            fov=FOV_DEG,
            x=x,
            y=y,
            half_x=x + 2 * floor.wall_m,
            half_y=y + 2 * floor.wall_m,
        )
        self._model = mujoco.MjModel.from_xml_string(text)
        self._data = mujoco.MjData(self._model)
        mujoco.mj_forward(self._model, self._data)
        self._option, self._camera = mujoco.MjvOption(), mujoco.MjvCamera()
        self._scene = mujoco.MjvScene(self._model, maxgeom=GEOMS)
        self._renderer = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._renderer)
        self._floor = floor

    def _look(self, env: WarehouseVectorEnv, index: int) -> None:
        camera = self._camera
        x, y, yaw = env.simulation.pose()[index]
        camera.lookat[:] = x + 1.2 * np.cos(yaw), y + 1.2 * np.sin(yaw), 0.3
        camera.distance = 4.4
        camera.azimuth, camera.elevation = float(np.degrees(yaw)), -33.0


def _parts(env: WarehouseVectorEnv, index: int, floor: Warehouse) -> Iterator[Part]:
    """Yield everything on the floor as parts, transparent ones last."""
    sim = env.simulation
    x, y, yaw = sim.pose()[index]
    yield from _robot(x, y, yaw, sim.robot, sim.lidar_x_m)
    for x, y, yaw in sim.pallets[index]:
        if x > PARKED_M[0] / 2:
            yield from _pallet(x, y, yaw)
    traffic = sim.traffic
    for agent, (x, y) in enumerate(traffic.position_m[index]):
        yaw = traffic.heading_rad[index, agent]
        if x > PARKED_M[0] / 2:
            yield from _person(x, y, agent) if agent < PEOPLE else _forklift(x, y, yaw)
    for rack in floor.racks:
        yield from _rack(rack)
    yield from _walls(floor)
    yield from _route(env.navigation.plans_m[index])
    x, y = env.navigation.goals_m[index]
    radius = env.task.goal_radius_m
    yield _CYLINDER, (x, y, 0.6), (0.025, 0.6, 0.0), 0.0, PLAN
    yield _BOX, (x + 0.15, y, 1.1), (0.15, 0.012, 0.1), 0.0, PLAN
    yield _CYLINDER, (x, y, 0.008), (radius, 0.008, 0.0), 0.0, GOAL
    for x, y, half_x, half_y, _ in sim.patches[index]:
        if half_x > 0:
            yield _BOX, (x, y, 0.002), (half_x, half_y, 0.002), 0.0, OIL


def _frame(x: float, y: float, yaw: float) -> Callable[[float, float, float], Place]:
    """Convert places ahead, left and up of a body to places on the floor."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    return lambda ahead, left, up: (x + cos * ahead - sin * left, y + sin * ahead + cos * left, up)


def _robot(x: float, y: float, yaw: float, robot: RobotModel, lidar_x_m: float) -> Iterator[Part]:
    at, half_x, half_y = _frame(x, y, yaw), robot.length_m / 2, robot.width_m / 2
    middle, up = -robot.axle_x_m, (robot.chassis_z_m + robot.chassis_height_m / 2) / 0.3
    edge = min(1.0, half_y / 0.25)  # the parts were drawn for a robot .5 m wide and .3 m high
    yield _BOX, at(middle, 0, 0.17 * up), (half_x, half_y, 0.11 * up), yaw, BODY
    deck = (half_x - 0.07 * edge, half_y - 0.07 * edge, 0.015 * up)
    yield _BOX, at(middle, 0, 0.29 * up), deck, yaw, DARK
    lamp = (0.006, half_y - 0.08 * edge, 0.02 * up)
    yield _BOX, at(middle + half_x, 0, 0.2 * up), lamp, yaw, LAMP
    for ahead in (0.16, 0.24):  # an arrow on the deck: which way is forward
        size = (0.02 * edge, (0.16 - ahead / 2) * edge, 0.003)
        yield _BOX, at(middle + ahead * edge, 0, 0.306 * up), size, yaw, LAMP
    radius = robot.wheel_radius_m
    for wheel_x, wheel_y in robot.wheels_m.tolist():
        yield _BOX, at(wheel_x, wheel_y, radius), (radius, 0.03 * edge, radius), yaw, DARK
    yield _CYLINDER, at(lidar_x_m, 0, 0.34 * up), (0.06 * edge, 0.04 * edge, 0.0), yaw, DARK


def _pallet(x: float, y: float, yaw: float) -> Iterator[Part]:
    half_x, half_y, half_z = PALLET_HALF_M
    yield _BOX, (x, y, 0.07), (half_x, half_y, 0.07), yaw, WOOD
    top = 2 * half_z - 0.14
    yield _BOX, (x, y, 0.14 + top / 2), (half_x - 0.03, half_y - 0.03, top / 2), yaw, LOAD


def _person(x: float, y: float, which: int) -> Iterator[Part]:
    yield _CAPSULE, (x, y, 0.45), (0.13, 0.32, 0.0), 0.0, TROUSERS
    yield _CAPSULE, (x, y, 1.12), (0.2, 0.24, 0.0), 0.0, VESTS[which % len(VESTS)]
    yield _SPHERE, (x, y, 1.62), (0.13, 0.0, 0.0), 0.0, SKIN
    yield _SPHERE, (x, y, 1.67), (0.135, 0.0, 0.0), 0.0, (1, 1, 1, 1)  # a helmet


def _forklift(x: float, y: float, yaw: float) -> Iterator[Part]:
    at, (half_x, half_y, half_z) = _frame(x, y, yaw), FORKLIFT_HALF_M
    yield _BOX, at(-0.12, 0, 0.4), (half_x - 0.12, half_y, 0.34), yaw, TRUCK
    yield _BOX, at(-0.2, 0, 2 * half_z + 0.5), (0.3, half_y - 0.05, 0.03), yaw, DARK
    for side in (1, -1):
        mast = at(half_x - 0.2, side * (half_y - 0.12), half_z + 0.3)
        yield _BOX, mast, (0.04, 0.04, half_z + 0.3), yaw, STEEL
        yield _BOX, at(half_x, side * 0.18, 0.06), (0.2, 0.06, 0.02), yaw, STEEL
        for ahead in (-0.4, 0.3):
            wheel = at(ahead, side * half_y, 0.14)
            yield _BOX, wheel, (0.14, 0.05, 0.14), yaw, DARK
        post = at(-0.45, side * (half_y - 0.08), 1.2)
        yield _BOX, post, (0.025, 0.025, 0.5), yaw, DARK


def _rack(rack: Rect) -> Iterator[Part]:
    """Yield a rack's posts, two shelves above the floor, and cartons on each of three levels."""
    x, y = rack.center
    half_x, half_y = rack.half_size
    top = 2 * RACK_HALF_HEIGHT_M
    for side_x in (-1, 1):
        for side_y in (-1, 1):
            corner = (x + side_x * (half_x - 0.04), y + side_y * (half_y - 0.04), top / 2)
            yield _BOX, corner, (0.04, 0.04, top / 2), 0.0, POST
    for level in range(3):
        up = 0.06 + level * top / 3
        yield _BOX, (x, y, up), (half_x, half_y, 0.03), 0.0, BEAM
        along = half_x >= half_y
        count = min(max(round(2 * max(half_x, half_y) / 0.65), 1), 40)
        bay = 2 * max(half_x, half_y) / count
        for slot in range(count):
            number = slot * 7 + level * 3 + round(10 * (x + y))
            tall = (0.13, 0.17, 0.10)[number % 3]
            offset = (slot + 0.5) * bay - max(half_x, half_y)
            at = (x + offset, y) if along else (x, y + offset)
            deep = min(half_x, half_y) - 0.05
            half = (bay / 2 - 0.04, deep) if along else (deep, bay / 2 - 0.04)
            yield _BOX, (*at, up + 0.03 + tall), (*half, tall), 0.0, CARTONS[number % 3]


def _walls(floor: Warehouse) -> Iterator[Part]:
    for middle, half in zip(*building_boxes(floor, 0), strict=True):
        yield _BOX, tuple(middle), tuple(half), 0.0, WALL


def _route(plan_m: NDArray[Any]) -> Iterator[Part]:
    """Yield the plan as a band on the floor, piece by piece."""
    step = np.diff(plan_m, axis=0)
    length = np.hypot(step[:, 0], step[:, 1])
    for start, (dx, dy), long in zip(plan_m[:-1], step, length, strict=True):
        if long > 1e-6:
            middle = (start[0] + dx / 2, start[1] + dy / 2, 0.006)
            yield _BOX, middle, (long / 2, 0.03, 0.004), float(np.arctan2(dy, dx)), PLAN


if __name__ == "__main__":
    sys.exit(main())
