"""The speed of the twin on MuJoCo Warp beside MuJoCo on all cores, and what a step there goes to.

    python benchmarks/twin_warp.py [--envs 64 1024 4096] [--device NAME] [--json]

For each number of environments both step the whole vector environment under random actions, in
turns; a figure is the median round's environment steps per second by the clock. `device` is Warp's
default, or the one named. Then a few steps with Warp are taken apart, waiting for the device after
every part: what goes to it and comes back (compared, packed and copied), the substeps on it, and
the rest of the step, which is the host's NumPy. Episodes that begin are within the steps.

The first run on a machine compiles Warp's kernels: most of them before anything is measured, a core
each, where a step alone would compile one after another. Lines appear as they are measured; with
`--json` on stderr.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from harness import finish, in_turns, medians, option_parser

from restock.errors import ConfigError
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.physics.simulation import Physics

ENVS = (64, 1024, 4096)
ROUNDS = 3
STEPS = 4096  # environment steps a round and contender, about; at least 3 steps of all, at most 24
PARTS = {  # of `WarpBatch`, in the order in which a rollout runs them
    "_send": "to the device: state and model",
    "_give": "to the device: controls",
    "_advance": "device",
    "_fetch": "from the device",
    "ray": "rays",
}


def compile_kernels(warp: Any) -> float:
    """Seconds to compile and load the kernels of a step, on all cores.

    They are found by a step of two environments that launches nothing.
    """
    began = time.perf_counter()
    env = WarehouseVectorEnv(2, seed=1, physics="warp")
    env.reset(seed=1)
    batch = env.simulation.batch
    modules: dict[int, list[Any]] = {}  # by threads a block

    def note(kernel: Any, *_: Any, block_dim: int = 256, **__: Any) -> None:
        if kernel.module not in modules.setdefault(block_dim, []):
            modules[block_dim].append(kernel.module)

    def once(_: Any, while_body: Callable[..., Any], **given: Any) -> None:
        while_body(**given)

    stubs = {"launch": note, "launch_tiled": note, "capture_while": once}
    before = {name: getattr(warp, name) for name in stubs}
    try:
        for name, stub in stubs.items():
            setattr(warp, name, stub)
        batch.rollout(1)
    finally:
        for name, function in before.items():
            setattr(warp, name, function)
    cores = os.cpu_count() or 1
    for block_dim, found in modules.items():
        warp.force_load(batch.device, found, block_dim, max_workers=cores)
    return time.perf_counter() - began


class Stepped:
    """A vector environment that is some steps into its episodes, under random actions."""

    def __init__(self, count: int, physics: Physics) -> None:
        began = time.perf_counter()
        self.env = WarehouseVectorEnv(count, seed=1, nthread=0, physics=physics)
        self.env.reset(seed=1)
        self._rng = np.random.default_rng(0)
        # As in a long run, some episode or other is always about to end.
        self.env.steps[:] = self._rng.integers(self.env.task.time_limit_steps, size=count)
        self.made_s = time.perf_counter() - began
        began = time.perf_counter()
        self.run(1)  # kernels are compiled and loaded
        self.first_s = time.perf_counter() - began
        self.run(2)

    def run(self, steps: int) -> None:
        for _ in range(steps):
            self.env.step(
                self._rng.integers(self.env.single_action_space.n, size=self.env.num_envs)
            )

    def per_second(self, steps: int) -> float:
        """Environment steps a second, over so many steps of all environments."""
        began = time.perf_counter()
        self.run(steps)
        return steps * self.env.num_envs / (time.perf_counter() - began)


def parts(stepped: Stepped, steps: int, synchronize: Callable[[], object]) -> dict[str, float]:
    """Part -> milliseconds of a step of all environments, by the clock.

    The parts are methods of the batch, timed from outside; none runs within another.
    """
    batch = stepped.env.simulation.batch
    spent = dict.fromkeys(PARTS.values(), 0.0)

    def timed(part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def run(*given: Any, **named: Any) -> Any:
            began = time.perf_counter()
            answer = function(*given, **named)
            synchronize()
            spent[part] += time.perf_counter() - began
            return answer

        return run

    for name, part in PARTS.items():
        setattr(batch, name, timed(part, getattr(batch, name)))
    began = time.perf_counter()
    stepped.run(steps)
    whole = time.perf_counter() - began
    for name in PARTS:
        delattr(batch, name)
    ms = {part: seconds / steps * 1e3 for part, seconds in spent.items() if seconds}
    ms["host"] = (whole - sum(spent.values())) / steps * 1e3
    return ms


def measured(count: int, warp: Any, say: Callable[[str], object]) -> dict[str, Any]:
    """The figures of so many environments."""
    steps = min(max(STEPS // count, 3), 24)
    contenders = {name: Stepped(count, name) for name in ("mujoco", "warp")}
    batch = contenders["warp"].env.simulation.batch
    for name, contender in contenders.items():
        say(
            f"{count:5d} environments, {name:6s}: made in {contender.made_s:.1f} s, first step"
            f" {contender.first_s:.1f} s"
        )
    rates = medians(
        in_turns(
            {name: partial(each.per_second, steps) for name, each in contenders.items()}, ROUNDS
        )
    )
    for name, rate in rates.items():
        say(f"{count:5d} environments, {name:6s}: {rate:9.0f} environment steps a second")
    say(f"{count:5d} environments, warp / mujoco: {rates['warp'] / rates['mujoco']:.2f}")
    say(f"substeps are one graph: {batch.captured or batch.not_captured}")
    batch.sent.clear()
    ms = parts(contenders["warp"], steps, partial(warp.synchronize_device, batch.device))
    whole = sum(ms.values())
    for part, value in ms.items():
        say(f"    {part:32s} {value:9.2f} ms a step {value / whole:7.1%}")
    sent = {name: times / steps for name, times in sorted(batch.sent.items())}
    say("    sent a step: " + ", ".join(f"{name} {times:.1f}" for name, times in sent.items()))
    return {
        "env_steps_per_second": rates,
        "warp_over_mujoco": rates["warp"] / rates["mujoco"],
        "captured": batch.captured,
        "not_captured": batch.not_captured,
        "first_step_s": {name: each.first_s for name, each in contenders.items()},
        "warp_ms_a_step": ms,
        "sent_a_step": sent,
    }


def main() -> int:
    parser = option_parser(__doc__)
    parser.add_argument("--envs", type=int, nargs="+", default=list(ENVS), help="how many")
    parser.add_argument("--device", help="Warp's name of one; without: its default")
    options = parser.parse_args()
    try:
        import mujoco_warp  # noqa: F401 - what is measured
        import warp
    except ImportError:
        print("MuJoCo Warp is not installed: pip install 'restock[mjwarp]'", file=sys.stderr)
        return 2
    warp.config.log_level = getattr(warp, "LOG_WARNING", None)
    say = partial(print, file=sys.stderr if options.json else sys.stdout, flush=True)
    try:
        with warp.ScopedDevice(options.device):
            device = warp.get_device()
            name = f"{device.name}, Warp {warp.__version__}; {os.cpu_count()} cores"
            say(name)
            try:
                compiled_s = compile_kernels(warp)
            except Exception as error:  # noqa: BLE001 - the first steps compile them as well
                say(f"kernels are compiled by the first steps: {error}")
                compiled_s = None
            else:
                say(f"kernels compiled and loaded in {compiled_s:.1f} s")
            by_count = {count: measured(count, warp, say) for count in options.envs}
    except (ConfigError, RuntimeError) as error:
        print(error, file=sys.stderr)
        return 2
    answer = {"device": name, "compiled_s": compiled_s, "environments": by_count}
    return finish(options, answer, [], [])


if __name__ == "__main__":
    sys.exit(main())
