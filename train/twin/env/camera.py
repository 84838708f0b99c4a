"""Frames of the twin by a camera: MuJoCo's renderer off screen, over EGL, with or without a GPU.

OpenGL is loaded when the first camera is made, never before. What it sees:
`restock.train.twin.env.stage`.

    env = gym.make("restock/Warehouse-v0", render_mode="rgb_array", camera="chase")
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, get_args

import mujoco
import numpy as np
from numpy.typing import NDArray

from restock.errors import ConfigError
from restock.train.twin.env.stage import parts
from restock.train.twin.floors.layout import Warehouse

if TYPE_CHECKING:
    from restock.train.twin.env.vector_env import WarehouseVectorEnv

View = Literal["chase", "overhead"]

WIDTH_PX, HEIGHT_PX = 640, 480
GEOMS = 4000
FOV_DEG = 45.0
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


def check_view(view: str | None) -> None:
    """Raises ConfigError where there is no such camera."""
    if view is not None and view not in get_args(View):
        raise ConfigError(
            f"there is no camera {view!r}",
            where="the twin",
            remedy=f"give {', '.join(get_args(View))}, or none for the drawn map",
        )


class Camera:
    """One camera and the GL context behind it; frames of any floor and environment.

    Raises:
        ConfigError: there is no EGL here.
    """

    def __init__(self, view: View, *, width: int = WIDTH_PX, height: int = HEIGHT_PX) -> None:
        self.view = view
        self._rect = mujoco.MjrRect(0, 0, width, height)
        self._context = _egl_context(width, height)
        self._floor: Warehouse | None = None
        self._renderer: Any = None

    def frame(self, env: WarehouseVectorEnv, index: int) -> NDArray[np.uint8]:
        """What it sees of one environment now, (H, W, 3) uint8."""
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
        for shape, place, half, yaw, color in parts(env, index, floor):
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
        """Give the context back."""
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
        why = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ConfigError(
            f"there is no EGL to render with: {why}",
            where="camera",
            remedy="install libegl1 libegl-mesa0 libgl1-mesa-dri libgbm1 (Debian's names), or leave"
            " `camera` out: the drawn map needs no GL",
        ) from error
    return context


__all__ = ["Camera", "View", "check_view"]
