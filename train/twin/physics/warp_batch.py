"""The twin's physics and lidar on MuJoCo Warp: a `mujoco.batch.Batch` whose work is done there.

    env = WarehouseVectorEnv(4096, physics="warp")

`WarpBatch` is the batch that the twin uses anyway; only `rollout` and `ray` are replaced. The state
stays in the batch's rows on the host and goes to Warp's device and back in every call, so resets,
layouts, perturbations, recorders and saved states are the same code on both. Needs the extra
`mjwarp`. The device is Warp's default: a CUDA device where there is one, else the CPU, where Warp
is much slower than MuJoCo itself.

Warp computes in 32-bit floats with a solver of its own, so its episodes are not those of MuJoCo bit
by bit. docs/mjwarp.md says how near they are.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import MODEL_FIELDS, Batch
from numpy.typing import NDArray

from restock.arrays import Bools
from restock.errors import ConfigError
from restock.imports import import_extra

CONTACTS, CONSTRAINTS = 64, 192  # room a simulation: four wheels, and a chassis against obstacles
_CTRL, _MOCAP = int(mujoco.mjtState.mjSTATE_CTRL), int(mujoco.mjtState.mjSTATE_MOCAP_POS)
_STATE = ("qpos", "qvel", "qacc_warmstart", "ctrl", "mocap_pos", "mocap_quat")
_MOVED = ("qpos", "qvel", "qacc_warmstart", "mocap_pos", "ctrl")
_MOST = 1e10  # MuJoCo's own limit of positions and velocities
# Both only save MuJoCo time (see `restock.train.twin.physics.model`), and Warp does not take the
# first.
_HOST_ONLY = int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE | mujoco.mjtDisableBit.mjDSBL_ISLAND)


class WarpBatch(Batch):  # type: ignore[misc]  # MuJoCo has no types
    """N simulations of one model, stepped on a Warp device."""

    def __init__(
        self, model: mujoco.MjModel, nsim: int, nthread: int = 1, device: str | None = None
    ) -> None:
        """`device` is Warp's name of one ("cuda:0", "cpu"); None: Warp's default.

        Raises:
            ConfigError: the extra is not installed, there is no such device, or the model asks for
                something that Warp does not do.
        """
        super().__init__(model, nsim, nthread)
        self._wp, self._mjw = _import()
        try:
            self.device = self._wp.get_device(device)
        except (RuntimeError, ValueError) as error:
            raise ConfigError(f"Warp has no device {device!r}", where="the twin") from error
        self._plain = copy.copy(model)
        self._plain.opt.disableflags &= ~_HOST_ONLY
        # Fields of the device's model with a value per simulation; stale: no longer all of them.
        self._per_simulation: frozenset[str] = frozenset()
        self._stale = True
        with self._wp.ScopedDevice(self.device):
            data = mujoco.MjData(self._plain)
            self._device_model = self._put_model()
            self._device_data = self._mjw.put_data(
                *(self._plain, data), nworld=nsim, nconmax=CONTACTS, njmax=CONSTRAINTS
            )

    def _put_model(self) -> Any:
        """The model on the device, with a value per simulation in the fields `_per_simulation`."""
        try:
            return self._mjw.put_model(self._plain, dict.fromkeys(self._per_simulation, self.nsim))
        except (NotImplementedError, ValueError) as error:
            raise ConfigError(
                f"MuJoCo Warp cannot run this twin: {error}",
                where="the twin",
                remedy='use physics="mujoco"',
            ) from error

    # -- fields per simulation ------------------------------------------------------------------

    def expand(self, name: str) -> NDArray[Any]:
        """As `Batch.expand`."""
        self._stale |= name not in self._expanded
        values: NDArray[Any] = super().expand(name)
        return values

    def set_const(self, ids: Any = None) -> None:
        """As `Batch.set_const`."""
        super().set_const(ids)
        self._stale = True  # what it derived has become a simulation's own

    def _send_model(self) -> None:
        if self._stale:
            known = set(dir(self._device_model))
            if unknown := sorted(set(self._expanded) - known):
                raise ConfigError(
                    f"MuJoCo Warp has no {', '.join(unknown)} for each simulation apart",
                    where="the twin",
                    remedy='use physics="mujoco"',
                )
            # Derived ones that Warp lacks it does not use.
            expanded = {name for name in MODEL_FIELDS if self.expanded(name) is not None} & known
            if expanded != self._per_simulation:
                self._per_simulation = frozenset(expanded)
                self._device_model = self._put_model()
            self._stale = False
        for name in self._per_simulation:
            array = getattr(self._device_model, name)
            array.assign(np.asarray(self.expanded(name), np.float32).reshape(_shape(array)))

    def _send_state(self) -> None:
        for name in _STATE:
            array = getattr(self._device_data, name)
            array.assign(np.asarray(self.bind(name), np.float32).reshape(_shape(array)))

    # -- what runs on the device ------------------------------------------------------------------

    def rollout(
        self,
        nstep: int,
        control: Any = None,
        control_spec: int = _CTRL,
        record: Sequence[Any] = ("qpos",),
        ids: Any = None,
        out: Any = None,
    ) -> dict[Any, NDArray[Any]]:
        """As `Batch.rollout`, for all simulations, controls and mocap positions, named records.

        A simulation that ends in no number, beyond MuJoCo's limits or with more constraints than
        there is room for gets a warning, and MuJoCo's own reset.
        """
        if ids is not None or out is not None or control_spec not in (_CTRL, _CTRL | _MOCAP):
            raise ValueError("WarpBatch.rollout takes all simulations and ctrl, or ctrl and mocap")
        wp, data, nu = self._wp, self._device_data, self.model.nu
        with wp.ScopedDevice(self.device):
            self._send_model()
            self._send_state()
            inputs: list[tuple[Any, Any]] = []  # where to, and all substeps' values
            if control is not None:
                width = nu + (3 * self.model.nmocap if control_spec & _MOCAP else 0)
                whole = np.broadcast_to(control, (self.nsim, nstep, width))
                steps = np.ascontiguousarray(whole.swapaxes(0, 1), np.float32)
                inputs.append((data.ctrl, wp.array(steps[..., :nu].copy(), dtype=float)))
                if control_spec & _MOCAP:
                    places = steps[..., nu:].reshape(nstep, self.nsim, self.model.nmocap, 3)
                    inputs.append((data.mocap_pos, wp.array(places.copy(), dtype=wp.vec3)))
            records = {}
            for name in (*record, "nefc"):
                source = getattr(data, name)
                kept = wp.empty((nstep, *source.shape), dtype=source.dtype)
                records[name] = source, kept
            for step in range(nstep):
                for target, values in inputs:
                    wp.copy(target, values[step])
                self._mjw.step(self._device_model, data)
                for source, kept in records.values():
                    wp.copy(kept[step], source)
            recorded = {name: kept.numpy().swapaxes(0, 1) for name, (_, kept) in records.items()}
            for name in _MOVED:
                rows = self.bind(name)
                rows[...] = getattr(data, name).numpy().reshape(rows.shape)
        self.bind("time")[...] += nstep * self.model.opt.timestep
        self._warn((recorded["nefc"] > CONSTRAINTS).any(axis=1))
        return {name: recorded[name].astype(np.float64) for name in record}

    def _warn(self, bad: Bools) -> None:
        for name in ("qpos", "qvel"):
            # Not "greater than": NaN is neither.
            bad |= ~(np.abs(self.bind(name)) < _MOST).all(axis=1)
        if bad.any():
            self.reset(np.flatnonzero(bad), stage=int(mujoco.mjtStage.mjSTAGE_NONE))
            self.warning.reshape(self.nsim, -1)[bad, int(mujoco.mjtWarning.mjWARN_BADQACC)] += 1

    def ray(
        self,
        pnt: Any,
        vec: Any,
        geomgroup: Any = None,
        flg_static: bool = True,
        bodyexclude: Any = -1,
        ids: Any = None,
        normal: bool = False,
    ) -> tuple[NDArray[Any], ...]:
        """As `Batch.ray`; for some simulations only, or with normals, by MuJoCo itself."""
        few = ids is not None and not np.array_equal(ids, np.arange(self.nsim))
        if few or normal or np.ndim(bodyexclude):
            return tuple(super().ray(pnt, vec, geomgroup, flg_static, bodyexclude, ids, normal))
        wp = self._wp
        pnt, vec = np.broadcast_arrays(np.atleast_2d(pnt), np.atleast_2d(vec))
        shape = (self.nsim, pnt.shape[-2])
        groups = [-1] * 6 if geomgroup is None else [int(group) for group in geomgroup]
        with wp.ScopedDevice(self.device):
            self._send_model()
            self._send_state()
            self._mjw.kinematics(self._device_model, self._device_data)
            lines = [
                wp.array(np.broadcast_to(part, (*shape, 3)).astype(np.float32), dtype=wp.vec3)
                for part in (pnt, vec)
            ]
            distance = wp.full(shape, -1.0, dtype=float)
            geom = wp.full(shape, -1, dtype=int)
            self._mjw.rays(
                *(self._device_model, self._device_data, *lines, wp.types.vector(6, float)(groups)),
                flg_static,
                wp.full(shape[1], int(bodyexclude), dtype=int),
                *(distance, geom, wp.zeros(shape, dtype=wp.vec3)),
            )
            return distance.numpy().astype(np.float64), geom.numpy()


def _shape(array: Any) -> tuple[int, ...]:
    """The NumPy shape of a Warp array: vectors and matrices are trailing axes."""
    return (*array.shape, *array.dtype._shape_) if hasattr(array.dtype, "_shape_") else array.shape


def _import() -> tuple[Any, Any]:
    use = 'physics="warp" needs MuJoCo Warp'
    mujoco_warp = import_extra("mujoco_warp", "mjwarp", use, where="the twin")
    warp = import_extra("warp", "mjwarp", use, where="the twin")
    warp.config.quiet = True
    return warp, mujoco_warp


__all__ = ["WarpBatch"]
