"""Frames by a camera over EGL; skipped by name where there is none."""

import subprocess
import sys

import gymnasium
import numpy as np
import pytest

from restock.errors import ConfigError
from restock.train.twin.env.render import Camera
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.physics.episode import EpisodeSpec


def _egl() -> bool:
    try:
        Camera("chase").close()
    except ConfigError:
        return False
    return True


needs_egl = pytest.mark.skipif(not _egl(), reason="no EGL here: libegl1 and a Mesa driver")
SPECS = [EpisodeSpec("near_collision", 14), EpisodeSpec("wheel_slip", 5)]


def _share(frame: np.ndarray, color: tuple[int, int, int], within: int = 45) -> float:
    """Return the share of a frame's pixels that are near a colour."""
    off = np.abs(frame.astype(int) - np.array(color)).max(axis=-1)
    return float((off < within).mean())


@needs_egl
@pytest.mark.parametrize("view", ["chase", "overhead"])
def test_a_camera_sees_the_robot_its_plan_and_the_floor(view: str) -> None:
    env = WarehouseVectorEnv(2, render_mode="rgb_array", camera=view)
    env.set_episodes(SPECS)
    env.reset()
    frames = env.render()
    assert frames is not None
    for frame in frames:
        assert (frame.shape, frame.dtype) == ((480, 640, 3), np.uint8)
        assert _share(frame, (250, 130, 30)) > 5e-4  # the robot's orange
        assert _share(frame, (30, 180, 90)) > 5e-4  # the plan's green
    dry, wet = (_share(frame, (60, 145, 205)) for frame in frames)
    assert wet > dry + 0.005
    again = env.render()
    assert again is not None
    assert all((a == b).all() for a, b in zip(frames, again, strict=True))
    env.simulation.place_robot(0, 6.0, 5.0, 0.0)
    moved = env.render()
    assert moved is not None
    assert (moved[0] != frames[0]).any()
    assert (moved[1] == frames[1]).all()
    env.close()


@needs_egl
def test_one_environment_renders_as_gymnasium_has_it() -> None:
    made = gymnasium.make("restock/Warehouse-v0", render_mode="rgb_array", camera="chase")
    made.reset(seed=1)
    frame = made.render()
    assert frame.shape == (480, 640, 3)
    made.step(1)
    assert (made.render() != frame).any()
    made.close()


def test_nothing_of_gl_is_loaded_for_the_drawn_map() -> None:
    code = (
        "import sys; from restock.train.twin.env.vector_env import WarehouseVectorEnv as E;"
        "e = E(1, render_mode='rgb_array'); e.reset(); e.render();"
        "sys.exit(any(n == 'OpenGL' or n.startswith('mujoco.egl') for n in sys.modules))"
    )
    environment = {"MUJOCO_GL": "disable", "PATH": "/usr/bin"}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_without_egl_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco.egl", None)  # as if it could not be imported
    with pytest.raises(ConfigError, match="EGL is unavailable") as raised:
        Camera("overhead")
    assert "libegl1" in str(raised.value.remedy)
    assert "the drawn map needs no GL" in str(raised.value.remedy)
