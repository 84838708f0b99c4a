"""The twin's physics and lidar on MuJoCo Warp: a `mujoco.batch.Batch` whose work is done there.

    env = WarehouseVectorEnv(4096, physics="warp")

`WarpBatch` is the batch that the twin uses anyway; only `rollout` and `ray` are replaced. The state
stays in the batch's rows on the host, so resets, layouts, perturbations, recorders and saved states
are the same code on both. To Warp's device goes what the host has changed since the device last had
it, and back comes what a rollout has moved. On a CUDA device the substeps of a rollout are one CUDA
graph. Needs the extra `mjwarp`. The device is Warp's default: a CUDA device where there is one,
else the CPU, where Warp is much slower than MuJoCo itself.

Warp computes in 32-bit floats with a solver of its own, so its episodes are not those of MuJoCo bit
by bit. docs/mjwarp.md says how near they are.
"""

from __future__ import annotations

import copy
import math
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
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
_CONTROLS = {_CTRL: ("ctrl",), _CTRL | _MOCAP: ("ctrl", "mocap_pos")}  # in the order of a control
_STATE = ("qpos", "qvel", "qacc_warmstart", "ctrl", "mocap_pos", "mocap_quat", "xfrc_applied")
_MOVED = ("qpos", "qvel", "qacc_warmstart")  # by a substep
_KINDS = 8  # of rollouts whose arrays and graphs are kept
_MOST = 1e10  # MuJoCo's own limit of positions and velocities
# Both only save MuJoCo time (see `restock.train.twin.physics.model`), and Warp does not take the
# first.
_HOST_ONLY = int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE | mujoco.mjtDisableBit.mjDSBL_ISLAND)


class WarpBatch(Batch):  # type: ignore[misc]  # MuJoCo has no types
    """N simulations of one model, stepped on a Warp device.

    `sent` counts how often each field of the state and the model went to the device. `captured`
    says whether the last rollout was a graph, and `not_captured` why none can be ("": they can).
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        nsim: int,
        nthread: int = 1,
        device: str | None = None,
        capture: bool | None = None,
    ) -> None:
        """`device` is Warp's name of one ("cuda:0", "cpu"); None: Warp's default.

        `capture`: rollouts as graphs, replayed; None: on a CUDA device.

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
        self.sent: Counter[str] = Counter()
        self.captured = False
        self.not_captured = _why_not_captured(self._wp, self.device, capture)
        self._rollouts: dict[tuple[Any, ...], _Rollout] = {}
        self._plain = copy.copy(model)
        self._plain.opt.disableflags &= ~_HOST_ONLY
        # Fields of the device's model with a value per simulation; stale: no longer all of them.
        self._fields: dict[str, _Mirrored] = {}
        self._stale = True
        self._placed = False  # the geoms on the device stand where its state says
        with self._wp.ScopedDevice(self.device):
            data = mujoco.MjData(self._plain)
            self._device_model = self._put_model(())
            self._device_data = self._mjw.put_data(
                *(self._plain, data), nworld=nsim, nconmax=CONTACTS, njmax=CONSTRAINTS
            )
            self._state = {
                name: _Mirrored(self._wp, getattr(self._device_data, name), self.bind(name))
                for name in _STATE
            }

    def _put_model(self, per_simulation: Iterable[str]) -> Any:
        """The model on the device, with a value per simulation in these fields."""
        try:
            return self._mjw.put_model(self._plain, dict.fromkeys(per_simulation, self.nsim))
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

    def _find_fields(self) -> None:
        known = set(dir(self._device_model))
        if unknown := sorted(set(self._expanded) - known):
            raise ConfigError(
                f"MuJoCo Warp has no {', '.join(unknown)} for each simulation apart",
                where="the twin",
                remedy='use physics="mujoco"',
            )
        # Derived ones that Warp lacks it does not use.
        expanded = {name for name in MODEL_FIELDS if self.expanded(name) is not None} & known
        if expanded != set(self._fields):
            self._rollouts.clear()  # their graphs are of the model that there was
            self._device_model = self._put_model(expanded)
            self._fields = {
                name: _Mirrored(self._wp, getattr(self._device_model, name), self.expand(name))
                for name in expanded
            }
        self._stale = False

    # -- what goes to the device and comes back ---------------------------------------------------

    def _send(self, without: Collection[str] = ()) -> None:
        """Send the fields of model and state that the host has changed, but for some of these."""
        if self._stale:
            self._find_fields()
        for name, field in (self._fields | self._state).items():
            if name not in without and field.send():
                self.sent[name] += 1
                self._placed = False

    def _give(self, rollout: _Rollout, control: NDArray[Any]) -> None:
        """Send the controls (N, nstep, width) of all substeps; the rows hold the last one's."""
        begin = 0
        for name, steps in zip(rollout.controls, rollout.inputs.host, strict=True):
            field = self._state[name]
            end = begin + field.values[0].size
            part = control[:, :, begin:end]
            steps[...] = part.swapaxes(0, 1).reshape(steps.shape)
            field.take(part[:, -1])
            begin = end
        rollout.inputs.send()

    def _fetch(self, rollout: _Rollout) -> dict[str, NDArray[Any]]:
        """Take what has moved into the rows. The records (nstep, N, …) last until the next one."""
        rollout.outputs.fetch()
        for name, moved in rollout.moved.items():
            self._state[name].take(moved)
        return rollout.records

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
        if ids is not None or out is not None or control_spec not in _CONTROLS:
            raise ValueError("WarpBatch.rollout takes all simulations and ctrl, or ctrl and mocap")
        controls = () if control is None else _CONTROLS[control_spec]
        with self._wp.ScopedDevice(self.device):
            self._send(without=controls)
            rollout = self._kind(nstep, controls, tuple(record))
            if controls:
                width = sum(self._state[name].values[0].size for name in controls)
                self._give(rollout, np.broadcast_to(control, (self.nsim, nstep, width)))
            self._advance(rollout)
            self._placed = False
            records = self._fetch(rollout)
        self.bind("time")[...] += nstep * self.model.opt.timestep
        self._warn(np.asarray((records["nefc"] > CONSTRAINTS).any(axis=0), np.bool_))
        return {name: records[name].swapaxes(0, 1).astype(np.float64) for name in record}

    def _kind(self, nstep: int, controls: tuple[str, ...], record: tuple[str, ...]) -> _Rollout:
        key = nstep, controls, record
        if key not in self._rollouts:
            if len(self._rollouts) >= _KINDS:
                self._rollouts.clear()
            self._rollouts[key] = _Rollout(self._wp, self._device_data, *key)
        return self._rollouts[key]

    def _advance(self, rollout: _Rollout) -> None:
        """Run the substeps: launched one by one the first time, which compiles and loads kernels,
        and then by a graph."""
        self.captured = rollout.under_way and not self.not_captured and self._replay(rollout)
        if not self.captured:
            self._substeps(rollout)
        rollout.under_way = True

    def _replay(self, rollout: _Rollout) -> bool:
        """Whether the substeps ran as a graph. What was only captured has not moved anything."""
        try:
            if rollout.graph is None:
                with self._wp.ScopedCapture() as capture:
                    self._substeps(rollout)
                rollout.graph = capture.graph
            self._wp.capture_launch(rollout.graph)
        except Exception as error:  # noqa: BLE001 - whatever it is, it goes on without a graph
            self.not_captured = f"{type(error).__name__}: {error}"
            for kind in self._rollouts.values():
                kind.graph = None
        return not self.not_captured

    def _substeps(self, rollout: _Rollout) -> None:
        wp, data = self._wp, self._device_data
        for step in range(rollout.nstep):
            for name, steps in zip(rollout.controls, rollout.inputs.device, strict=True):
                wp.copy(getattr(data, name), steps[step])
            self._mjw.step(self._device_model, data)
            for name, kept in rollout.kept.items():
                wp.copy(kept[step], getattr(data, name))
        for name, last in rollout.last.items():
            wp.copy(last, getattr(data, name))

    def _warn(self, bad: Bools) -> None:
        for name in ("qpos", "qvel"):
            # Not "greater than": NaN is neither.
            bad |= ~(np.abs(self._state[name].values) < _MOST).all(axis=1)
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
            self._send()
            if not self._placed:
                self._mjw.kinematics(self._device_model, self._device_data)
                self._placed = True
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


class _Mirrored:
    """An array of the host and the device's, which has what the host had when they last met."""

    def __init__(self, wp: Any, array: Any, values: NDArray[Any]) -> None:
        """`values` are the batch's, live; `array` is the device's."""
        self.values = values
        self._wp, self._array = wp, array
        self._known: NDArray[Any] | None = None  # copy of the values; None: they never met
        self._staged = _empty_on_host(wp, array.shape, array.dtype, array.device)
        self._view = self._staged.numpy().reshape(values.shape)

    def send(self) -> bool:
        """Send the values if the host has changed them; whether it had."""
        if self._known is not None and np.array_equal(self.values, self._known):
            return False
        np.copyto(self._view, self.values, casting="unsafe")
        self._wp.copy(self._array, self._staged)
        self._meet()
        return True

    def take(self, values: NDArray[Any]) -> None:
        """Write values into the host's that the device has already, or will when it has run."""
        self.values[...] = values.reshape(self.values.shape)
        self._meet()

    def _meet(self) -> None:
        if self._known is None:
            self._known = self.values.copy()
        else:
            np.copyto(self._known, self.values)


class _Packed:
    """Arrays of 32-bit numbers that lie one after another, so that one transfer takes all."""

    def __init__(self, wp: Any, on: Any, arrays: Sequence[tuple[tuple[int, ...], Any]]) -> None:
        """`arrays` are shapes and Warp's types; `device` and `host` have them in this order."""
        self._wp, self._on = wp, on
        sizes = [math.prod(_whole_shape(*array)) for array in arrays]
        self._device = wp.empty(sum(sizes), dtype=float, device=on)
        self._host = _empty_on_host(wp, (sum(sizes),), float, on)
        self.device: list[Any] = []
        self.host: list[NDArray[Any]] = []
        begin = 0
        for (shape, dtype), size in zip(arrays, sizes, strict=True):
            there, here = (
                wp.array(ptr=whole.ptr + 4 * begin, dtype=dtype, shape=shape, device=whole.device)
                for whole in (self._device, self._host)
            )
            self.device.append(there)
            self.host.append(here.numpy())
            begin += size

    def send(self) -> None:
        self._wp.copy(self._device, self._host)

    def fetch(self) -> None:
        """Wait for the device, and copy what it has."""
        self._wp.copy(self._host, self._device)
        self._wp.synchronize_stream(self._on)


class _Rollout:
    """One kind of rollout: what goes to the device for it, what comes back, and its graph."""

    def __init__(
        self, wp: Any, data: Any, nstep: int, controls: tuple[str, ...], record: tuple[str, ...]
    ) -> None:
        """`data` is the device's."""
        self.nstep, self.controls = nstep, controls
        self.graph: Any = None  # of its substeps, in these arrays
        self.under_way = False  # it has run, so its kernels are loaded
        record = tuple(dict.fromkeys((*record, "nefc")))
        arrays = {name: getattr(data, name) for name in (*controls, *record, *_MOVED)}
        every = {name: ((nstep, *array.shape), array.dtype) for name, array in arrays.items()}
        on = data.qpos.device
        self.inputs = _Packed(wp, on, [every[name] for name in controls])
        self.outputs = _Packed(
            *(wp, on),
            [every[name] for name in record]
            + [(arrays[name].shape, arrays[name].dtype) for name in _MOVED],
        )
        there, here, count = self.outputs.device, self.outputs.host, len(record)
        self.kept = dict(zip(record, there[:count], strict=True))  # at every substep
        self.records = dict(zip(record, here[:count], strict=True))
        self.last = dict(zip(_MOVED, there[count:], strict=True))  # at the end
        self.moved = dict(zip(_MOVED, here[count:], strict=True))


def _whole_shape(shape: tuple[int, ...], dtype: Any) -> tuple[int, ...]:
    """The NumPy shape of a Warp array: vectors and matrices are trailing axes."""
    return (*shape, *getattr(dtype, "_shape_", ()))


def _empty_on_host(wp: Any, shape: tuple[int, ...], dtype: Any, device: Any) -> Any:
    """An array of the host to exchange with a device: pinned, where that is another."""
    return wp.empty(shape, dtype=dtype, device="cpu", pinned=device.is_cuda)


def _why_not_captured(wp: Any, device: Any, capture: bool | None) -> str:
    """Why rollouts on a device cannot be graphs, or are not to be; "" where they can."""
    if not (device.is_cuda if capture is None else capture):
        return "it is not asked for"
    if device.is_cuda and not wp.is_mempool_enabled(device):  # a step allocates
        return "Warp's memory pool is off"
    # The solver iterates until all simulations have converged.
    if device.is_cuda and not wp.is_conditional_graph_supported():
        return "the driver or Warp is of a CUDA before 12.4"
    return ""


def _import() -> tuple[Any, Any]:
    use = 'physics="warp" needs MuJoCo Warp'
    mujoco_warp = import_extra("mujoco_warp", "mjwarp", use, where="the twin")
    warp = import_extra("warp", "mjwarp", use, where="the twin")
    # Its standard output is for data.
    warp.config.quiet = True
    if hasattr(warp, "LOG_WARNING"):  # in newer ones, in place of the former
        warp.config.log_level = warp.LOG_WARNING
    return warp, mujoco_warp


__all__ = ["WarpBatch"]
