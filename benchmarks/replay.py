"""What sampling costs beside other libraries' buffers, in one interleaved run.

    python benchmarks/replay.py [--quick] [--json] [--check] [--only SECTION]

Every contender fills a batch of 256 rows of equal width from a million rows in memory, on one
thread: uniformly, by quota, and by priority with weights and the update of the priorities. Figures
are medians over rounds of CPU time, in which contenders take turns. Then: quotas over ten million
rows, what a panel and its index cost to build, the record of what was fed as a share of an update,
and the fresh ring. `--check` exits 1 where a
target of the design is missed. Libraries that are not installed are left out.
"""

from __future__ import annotations

import gc
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import replay_contenders as contenders
import torch
from harness import cpu_us, finish, in_turns, medians, option_parser
from replay_contenders import (
    ACTIONS,
    BATCH,
    OBSERVATION,
    SHARES,
    IndexSelected,
    MultinomialDraw,
    Packed,
    Prioritised,
    RowsAlone,
    in_memory,
    quota_sampler,
    strata,
)

from restock.replay.sampling.packed_rows import row_width
from restock.replay.sampling.ring import FreshRing
from restock.replay.sampling.sampler import QuotaSampler, uniform_sampler

MANY_WIDTH = 16  # floats in a row, of ten million
RECORD_TARGET = 0.06
QUOTA_TARGET = 1.2
# Times gathering the rows alone, at most: memory decides what that takes, and so how far ahead of
# other libraries a draw can be.
TARGETS = {"uniform": 1.3, "per": 2.2}


def measure(contenders: dict[str, Callable[[], None]], rounds: int, draws: int) -> dict[str, float]:
    """Median over rounds of the CPU microseconds of one batch; contenders take turns."""

    def timed(name: str) -> float:
        contenders[name]()
        return cpu_us(contenders[name], max(draws // 50, 2) if name == "multinomial" else draws)

    return medians(in_turns({name: partial(timed, name) for name in contenders}, rounds))


def sampling(quick: bool) -> dict[str, Any]:
    """Batches from a million rows beside the other libraries': uniform, by quota, by priority."""
    count = 200_000 if quick else 1_000_000
    rows = in_memory(count, row_width(OBSERVATION))
    stratum_rows = strata(count)
    columns = contenders.Columns(rows.numpy(), OBSERVATION, ACTIONS)
    peers, left_out = installed(contenders.uniform(columns, BATCH))
    us = measure(
        {
            "uniform": Packed(rows, uniform_sampler(count, BATCH, np.random.default_rng(0))),
            "uniform_by_index_select": IndexSelected(
                rows, uniform_sampler(count, BATCH, np.random.default_rng(0))
            ),
            "rows_alone": RowsAlone(rows),
            "quotas": Packed(rows, quota_sampler(stratum_rows)),
            "quotas_in_turns": Packed(rows, quota_sampler(stratum_rows, replacement=False)),
            "multinomial": MultinomialDraw(rows, stratum_rows),
            **peers,
        },
        *_turns(quick),
    )
    del peers
    gc.collect()  # the peers' copies of the rows: those for PER come next
    errors = np.random.default_rng(2).exponential(size=count).astype(np.float32)

    def by_priority(parts: list[np.ndarray], shares: Any) -> Prioritised:
        rng = np.random.default_rng(0)
        return Prioritised(rows, QuotaSampler(parts, shares, BATCH, rng, within="per"), errors)

    everything = [np.arange(count)]
    peers, more_left_out = installed(contenders.prioritised(columns, BATCH, errors))
    us |= measure(
        {
            "per": by_priority(everything, [1.0]),
            "per_within_quotas": by_priority(stratum_rows, SHARES),
            **peers,
        },
        *_turns(quick),
    )
    return {
        "rows": count,
        "batch": BATCH,
        "row_floats": row_width(OBSERVATION),
        "cpu_us_per_batch": us,
        "left_out": left_out | more_left_out,
        "over_rows_alone": {name: us[name] / us["rows_alone"] for name in TARGETS},
        "quotas / uniform": us["quotas"] / us["uniform"],
    }


def installed(
    peers: dict[str, Callable[[], None] | str],
) -> tuple[dict[str, Callable[[], None]], dict[str, str]]:
    """Return the other libraries' draws, and why some are left out."""
    draws = {name: draw for name, draw in peers.items() if callable(draw)}
    return draws, {name: why for name, why in peers.items() if isinstance(why, str)}


def ten_million(count: int, rounds: int, draws: int) -> dict[str, float]:
    """Quotas beside uniform draws over many rows, and the building of their index."""
    stratum_rows = strata(count)
    began = time.process_time()
    sampler = quota_sampler(stratum_rows)
    index_s, began = time.process_time() - began, time.process_time()
    in_turns = quota_sampler(stratum_rows, replacement=False)
    shuffled_index_s = time.process_time() - began
    rows = in_memory(count, MANY_WIDTH)
    us = measure(
        {
            "uniform": Packed(rows, uniform_sampler(count, BATCH, np.random.default_rng(0))),
            "quotas": Packed(rows, sampler),
            "quotas_in_turns": Packed(rows, in_turns),
        },
        rounds,
        draws,
    )
    return {
        "rows": count,
        "row_floats": MANY_WIDTH,
        "index_s": index_s,
        "shuffled_index_s": shuffled_index_s,
        **{f"{name}_us": value for name, value in us.items()},
        "quotas / uniform": us["quotas"] / us["uniform"],
    }


def panel_build(count: int) -> dict[str, float]:
    """Return a panel of `count` rows from an Arrow table, checksummed."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    import pyarrow as pa
    from support.stores import CONDITIONS, recording_transitions

    from restock.ingest.task.task import Body, Task
    from restock.replay.mixture.mixture import load_mixture
    from restock.replay.panel.build import build_panel

    actions = tuple((float(i), 0.0) for i in range(ACTIONS))
    task = Task(body=Body(length_m=0.7, width_m=0.5), actions=actions)
    recordings = max(count // 20_000, 1)
    table = pa.concat_tables(
        [recording_transitions(i, episodes=600, task=task) for i in range(1, recordings + 1)]
    )
    with tempfile.TemporaryDirectory() as folder:
        began = time.process_time()
        panel = build_panel(
            table, load_mixture("coverage"), Path(folder) / "p", conditions=CONDITIONS
        )
        elapsed = time.process_time() - began
        return {"rows": len(table), "packed": len(panel), "rows_per_cpu_s": len(table) / elapsed}


def record_share(rounds: int, updates: int) -> dict[str, float]:
    """Measure an update of the default recipe with and without the record of what was fed."""
    from own_updates import Restock, config
    from train_peers import data

    from restock.train.run.run import Run

    arrays, settings = data(np.random.default_rng(0)), config(128)
    with tempfile.TemporaryDirectory() as folder:
        run = Run.create(Path(folder) / "run", {})
        contenders = {
            "plain": Restock(settings, arrays, run=None, logs=True),
            "recorded": Restock(settings, arrays, run=run, logs=True),
        }
        for contender in contenders.values():
            contender(updates)
        timed = {name: partial(_us, run, updates) for name, run in contenders.items()}
        times = in_turns(timed, rounds)
    plain, recorded = np.array(times["plain"]), np.array(times["recorded"])
    return {
        "update_us": float(np.median(plain)),
        "recorded_us": float(np.median(recorded)),
        "share": float(np.median(recorded / plain)) - 1,
    }


def _us(run: Callable[[int], object], updates: int) -> float:
    """CPU microseconds of one update."""
    return cpu_us(lambda: run(updates), 1) / updates


def fresh_ring(steps: int) -> dict[str, float]:
    """Measure appending steps of 16 environments, with three-step returns and late labels."""
    us = {}
    for name, reserved in (("", {}), ("reserved_", {"rare": 10_000})):
        envs, length = 16, 100
        ring = FreshRing(
            50_000,
            envs,
            OBSERVATION,
            discount=0.99,
            n_step=3,
            conditions=("rare", "nominal"),
            reserved=reserved,
        )
        rng = np.random.default_rng(0)
        observation = rng.normal(size=(envs, OBSERVATION)).astype(np.float32)
        action, reward = np.zeros(envs, np.int64), np.zeros(envs, np.float32)
        never, labels = np.zeros(envs, np.bool_), np.ones(length + 1, np.int64)
        began = time.process_time()
        for step in range(steps):
            ended = (np.arange(envs) * 6 + step) % length == 0
            keys = ring.append(
                observation=observation,
                action=action,
                reward=reward,
                terminated=ended,
                truncated=never,
                next_observation=observation,
                env_step=step * envs,
                gradient_step=step,
            )
            for key in keys[ended]:
                ring.set_labels(int(key), labels)
        step_us = (time.process_time() - began) / steps * 1e6
        us |= {f"{name}append_us": step_us, f"{name}append_us_per_env_step": step_us / envs}
    return us


def main() -> int:
    parser = option_parser(__doc__, quick="fewer rows and rounds")
    parser.add_argument("--only", choices=SECTIONS, action="append", help="may be repeated")
    options = parser.parse_args()
    torch.set_num_threads(1)
    figures: dict[str, Any] = {}
    for name in options.only or SECTIONS:
        print(f"measuring {name} …", file=sys.stderr)
        figures[name] = SECTIONS[name](options.quick)
        gc.collect()
    return finish(options, figures, missed(figures), lines(figures))


def _turns(quick: bool) -> tuple[int, int]:
    """Return the rounds, and the draws of each contender in one."""
    return (5, 128) if quick else (7, 384)


SECTIONS: dict[str, Callable[[bool], dict[str, Any]]] = {
    "sampling": sampling,
    "many_rows": lambda quick: ten_million(1_000_000 if quick else 10_000_000, *_turns(quick)),
    "panel_build": lambda quick: panel_build(20_000 if quick else 200_000),
    "record": lambda quick: record_share(*((5, 100) if quick else (15, 300))),
    "fresh_ring": lambda quick: fresh_ring(500 if quick else 5000),
}


def missed(figures: dict[str, Any]) -> list[str]:
    """Return the targets of the design that these figures miss."""
    ratios = figures["sampling"]["over_rows_alone"] if "sampling" in figures else {}
    misses = [
        f"{name} / the rows alone: {ratio:.2f}, at most {TARGETS[name]:g}"
        for name, ratio in ratios.items()
        if ratio > TARGETS[name]
    ]
    for part in (figures[name] for name in ("sampling", "many_rows") if name in figures):
        if (ratio := part["quotas / uniform"]) > QUOTA_TARGET:
            where = f"quotas / uniform at {part['rows']:,} rows"
            misses.append(f"{where}: {ratio:.2f}, at most {QUOTA_TARGET:g}")
    if "record" in figures and (share := figures["record"]["share"]) > RECORD_TARGET:
        misses.append(f"record: {share:.1%} of an update, at most {RECORD_TARGET:.0%}")
    return misses


def lines(result: dict[str, Any]) -> Iterator[str]:
    """Yield the figures as a table and lines, for people."""
    for section, figures in result.items():
        if section != "sampling":
            line = ", ".join(f"{key} {value:,.4g}" for key, value in figures.items())
            yield f"{section}: {line}"
            continue
        us = figures["cpu_us_per_batch"]
        yield f"{figures['rows']:,} rows of {figures['row_floats']} floats, batch {BATCH}"
        for name, value in us.items():
            times = value / us["uniform"]
            yield f"  {name:22} {value:10.1f} us of CPU a batch {times:8.2f} x uniform"
        yield from (f"  {n:22} left out: {why}" for n, why in figures["left_out"].items())
        for name, ratio in figures["over_rows_alone"].items():
            yield f"  {name} / the rows alone: {ratio:.2f} (target at most {TARGETS[name]:g})"


if __name__ == "__main__":
    sys.exit(main())
