"""Pictures of the twin: maps drawn from above, and frames by a camera.

A camera is MuJoCo's renderer off screen, over EGL, with or without a GPU. OpenGL is loaded when the
first camera is made, never before; drawn maps need none. Objects (boxes, cylinders, spheres and
capsules) are drawn from the environment's state (its floor, pallets, patches, traffic, plan, goal
and pose), not from the physics model: so racks have shelves and people have heads, and drawing
cannot affect the physics.

    env = gym.make("restock/Warehouse-v0", render_mode="rgb_array", camera="chase")
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from restock.arrays import F64, Bools
from restock.errors import ConfigError
from restock.train.twin.floors.layout import (
    FORKLIFT_HALF_M,
    HEADINGS,
    PALLET_HALF_M,
    PARKED_M,
    PATCHES,
    PEOPLE,
    PERSON_RADIUS_M,
    Rect,
    Warehouse,
)
from restock.train.twin.floors.occupancy_grid import OCCUPIED, OccupancyGrid, into_frame
from restock.train.twin.physics.model import RACK_HALF_HEIGHT_M, building_boxes
from restock.train.twin.physics.robot_model import RobotModel

if TYPE_CHECKING:
    from restock.train.twin.env.vector_env import WarehouseVectorEnv


Pixel = tuple[int, int, int]

FLOOR, RACK, PALLET, PERSON = (238, 238, 236), (92, 108, 132), (176, 130, 80), (45, 110, 200)
FORKLIFT, ICE, ROUTE, ROBOT, MAP_GOAL = (
    *((225, 180, 20), (150, 205, 235), (120, 180, 120)),
    *((240, 130, 30), (30, 150, 60)),
)
AISLE, DOCK, ONE_WAY, MAP_WALL = (222, 232, 220), (250, 214, 150), (205, 70, 60), (70, 74, 80)
FLOOR_PIXELS, MAP_PIXELS_PER_M = 960, 40  # of a floor's longer side


def draw_floor(
    floor: Warehouse, grid: OccupancyGrid | None = None, driven_m: F64 | None = None
) -> NDArray[np.uint8]:
    """Draw racks, aisles, docks, goals and one-way rules, (H, W, 3) uint8, north up, with walls.

    Of a floor that was made from a `grid` its occupied cells are drawn too, and the places that the
    robot drove through, `driven_m` (N, 2) in the map's frame.
    """
    canvas = _Canvas(floor, int(FLOOR_PIXELS / max(floor.width_m, floor.depth_m)))
    for color, areas in (
        (AISLE, [segment.area for segment in floor.segments]),
        (DOCK, [dock.area for dock in floor.docks]),
        (RACK, floor.racks),
    ):
        for area in areas:
            canvas.fill(area, color)
    if grid is not None:
        canvas.cells(grid.occupancy == OCCUPIED, grid.cell_m, MAP_WALL)
    if driven_m is not None:
        for x, y in into_frame(driven_m, floor.map_origin).tolist():
            canvas.disc(x, y, 0.03, ROBOT)
    for x, y in floor.goals.tolist():
        canvas.fill(Rect(x - 0.06, y - 0.06, x + 0.06, y + 0.06), MAP_GOAL)
    for rule in floor.one_way:
        canvas.arrow(*rule.area.center, HEADINGS[rule.heading], ONE_WAY)
    return canvas.pixels(wall=4)


def draw_map(env: WarehouseVectorEnv, index: int) -> NDArray[np.uint8]:
    """Draw one environment as it is now, (H, W, 3) uint8, north up."""
    floor = env.floor_of(index)
    canvas = _Canvas(floor, MAP_PIXELS_PER_M)
    sim = env.simulation
    for row in range(PATCHES):
        x, y, half_x, half_y, _ = sim.patches[index, row]
        canvas.box(x, y, half_x, half_y, 0.0, ICE)
    for rack in floor.racks:
        canvas.box(*rack.center, *rack.half_size, 0.0, RACK)
    for x, y in _dense(env.navigation.plans_m[index]):
        canvas.disc(x, y, 0.03, ROUTE)
    goal_x, goal_y = env.navigation.goals_m[index]
    canvas.disc(goal_x, goal_y, env.task.goal_radius_m, MAP_GOAL)
    for x, y, yaw in sim.pallets[index]:
        canvas.box(x, y, *PALLET_HALF_M[:2], yaw, PALLET)
    for agent, (x, y) in enumerate(sim.traffic.position_m[index]):
        if agent < PEOPLE:
            canvas.disc(x, y, PERSON_RADIUS_M, PERSON)
        else:
            yaw = sim.traffic.heading_rad[index, agent]
            canvas.box(x, y, *FORKLIFT_HALF_M[:2], yaw, FORKLIFT)
    x, y, yaw = sim.middle(sim.pose())[index]
    body = env.task.body
    canvas.box(x, y, body.length_m / 2, body.width_m / 2, yaw, ROBOT)
    nose = body.length_m / 2 - 0.1
    canvas.disc(x + nose * np.cos(yaw), y + nose * np.sin(yaw), 0.06, (60, 40, 20))
    return canvas.pixels()


class _Canvas:
    """The pixels of a floor, with rows from the south."""

    def __init__(self, floor: Warehouse, pixels_per_m: int) -> None:
        height, width = round(floor.depth_m * pixels_per_m), round(floor.width_m * pixels_per_m)
        self._image = np.empty((height, width, 3), np.uint8)
        self._image[:] = FLOOR
        self._scale = pixels_per_m
        self._x = (np.arange(width) + 0.5) / pixels_per_m
        self._y = (np.arange(height) + 0.5) / pixels_per_m

    def fill(self, area: Rect, color: Pixel) -> None:
        """Fill an axis-aligned box, its edges rounded to whole pixels."""
        x0, y0, x1, y1 = (round(edge * self._scale) for edge in area.edges)
        self._image[y0:y1, x0:x1] = color

    def cells(self, cells: Bools, cell_m: float, color: Pixel) -> None:
        """Fill the pixels whose centres are in these cells (X, Y), from the south-west corner."""
        column, row = (
            np.minimum((at / cell_m).astype(np.int64), size - 1)
            for at, size in zip((self._x, self._y), cells.shape, strict=True)
        )
        self._image[cells[np.ix_(column, row)].T] = color

    def box(
        self, x: float, y: float, half_x: float, half_y: float, yaw: float, color: Pixel
    ) -> None:
        window, dx, dy = self._window(x, y, float(np.hypot(half_x, half_y)))
        cos, sin = np.cos(yaw), np.sin(yaw)
        inside = (np.abs(cos * dx + sin * dy) <= half_x) & (np.abs(cos * dy - sin * dx) <= half_y)
        self._image[window][inside] = color

    def disc(self, x: float, y: float, radius: float, color: Pixel) -> None:
        window, dx, dy = self._window(x, y, radius)
        self._image[window][dx * dx + dy * dy <= radius * radius] = color

    def arrow(self, x: float, y: float, heading: tuple[int, int], color: Pixel) -> None:
        """Draw a triangle around a place, pointing along `heading`."""
        window, dx, dy = self._window(x, y, 0.4)
        ahead = heading[0] * dx + heading[1] * dy
        aside = np.abs(heading[1] * dx - heading[0] * dy)
        inside = (ahead > -0.35) & (ahead < 0.35) & (aside < (0.35 - ahead) / 2)
        self._image[window][inside] = color

    def _window(self, x: float, y: float, reach: float) -> tuple[tuple[slice, slice], F64, F64]:
        columns = slice(*np.searchsorted(self._x, [x - reach, x + reach]))
        rows = slice(*np.searchsorted(self._y, [y - reach, y + reach]))
        return (rows, columns), self._x[None, columns] - x, self._y[rows, None] - y

    def pixels(self, wall: int = 0) -> NDArray[np.uint8]:
        """Return the pixels (H, W, 3), north first, with this many pixels of wall around."""
        height, width, _ = self._image.shape
        framed = np.empty((height + 2 * wall, width + 2 * wall, 3), np.uint8)
        framed[:] = MAP_WALL
        framed[wall : wall + height, wall : wall + width] = self._image[::-1]
        return framed


def _dense(plan_m: F64) -> F64:
    """Return a polyline with three more points in every segment."""
    share = np.arange(4)[None, :, None] / 4
    return (plan_m[:-1, None] * (1 - share) + plan_m[1:, None] * share).reshape(-1, 2)


def write_png(path: Path, image: NDArray[np.uint8]) -> None:
    """Write pixels (H, W, 3). Raises ConfigError if they cannot be written."""
    try:
        Image.fromarray(image).save(path, format="PNG")
    except OSError as error:
        raise ConfigError(f"cannot be written: {error.strerror}", where=str(path)) from error


View = Literal["chase", "overhead"]

WIDTH_PX, HEIGHT_PX = 640, 480
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


class Renderer:
    """A source of frames: drawn maps, or those of a camera that is made on first use."""

    def __init__(self, view: View | None) -> None:
        self._view = view
        self._camera: Camera | None = None

    def frames(self, env: WarehouseVectorEnv) -> tuple[NDArray[np.uint8], ...]:
        """Return a frame of each environment as it is now, (H, W, 3) uint8."""
        if self._view is not None and self._camera is None:
            self._camera = Camera(self._view)
        frame = draw_map if self._camera is None else self._camera.frame
        return tuple(frame(env, index) for index in range(env.num_envs))

    def close(self) -> None:
        """Release the camera's GL context."""
        if self._camera is not None:
            self._camera.close()
            self._camera = None


class Camera:
    """A camera and its GL context, which renders any floor and environment.

    Raises:
        ConfigError: EGL is unavailable.
    """

    def __init__(self, view: View, *, width: int = WIDTH_PX, height: int = HEIGHT_PX) -> None:
        self.view = view
        self._rect = mujoco.MjrRect(0, 0, width, height)
        self._context = _egl_context(width, height)
        self._floor: Warehouse | None = None
        self._renderer: Any = None

    def frame(self, env: WarehouseVectorEnv, index: int) -> NDArray[np.uint8]:
        """Return the camera's picture of one environment now, (H, W, 3) uint8."""
        self._context.make_current()
        floor = env.floor_of(index)
        if floor is not self._floor:
            self._build(floor)
        self._look(env, index, floor)
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

    def _look(self, env: WarehouseVectorEnv, index: int, floor: Warehouse) -> None:
        camera = self._camera
        if self.view == "overhead":
            aspect = self._rect.width / self._rect.height
            tall = max(floor.depth_m, floor.width_m / aspect) + 0.6
            camera.lookat[:] = floor.width_m / 2, floor.depth_m / 2, 0.0
            camera.distance = tall / 2 / np.tan(np.radians(FOV_DEG / 2))
            camera.azimuth, camera.elevation = 90.0, -90.0
            return
        x, y, yaw = env.simulation.pose()[index]
        camera.lookat[:] = x + 1.2 * np.cos(yaw), y + 1.2 * np.sin(yaw), 0.3
        camera.distance = 4.4
        camera.azimuth, camera.elevation = float(np.degrees(yaw)), -33.0


def _egl_context(width: int, height: int) -> Any:
    try:
        from mujoco.egl import GLContext  # here: it loads OpenGL

        context = GLContext(width, height)
        context.make_current()
    except Exception as error:  # whatever a driver or a missing library throws
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ConfigError(
            f"EGL is unavailable: {reason}",
            where="camera",
            remedy="install libegl1 libegl-mesa0 libgl1-mesa-dri libgbm1 (Debian's names), or "
            "leave out `camera`: the drawn map needs no GL",
        ) from error
    return context


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


def _route(plan_m: F64) -> Iterator[Part]:
    """Yield the plan as a band on the floor, piece by piece."""
    step = np.diff(plan_m, axis=0)
    length = np.hypot(step[:, 0], step[:, 1])
    for start, (dx, dy), long in zip(plan_m[:-1], step, length, strict=True):
        if long > 1e-6:
            middle = (start[0] + dx / 2, start[1] + dy / 2, 0.006)
            yield _BOX, middle, (long / 2, 0.03, 0.004), float(np.arctan2(dy, dx)), PLAN
