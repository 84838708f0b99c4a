"""How well novelty ranks what the rules name, and what it costs as a store grows.

    python benchmarks/novelty.py [STORE] [--rows 100000 1000000 10000000] [--quick]

Without STORE, that of the sample logs. AUROC of each condition: how often one of its rows is
stranger than a row without it; beside it the same for other references and for standardised
entries, whose choice docs/coverage.md explains. Then the time and memory of so many rows, which are
the store's own, again and again under other ids.
What a quota on novel rows is worth: `python benchmarks/evidence.py novelty`.
"""

from __future__ import annotations

import resource
import tempfile
import time
from pathlib import Path

import duckdb
import numpy as np
import pyarrow as pa
from harness import finish, markdown, option_parser, run_restock
from scipy.stats import mannwhitneyu

from restock.arrays import F32, Bools
from restock.replay.store.novelty import REFERENCE, Reference, read_novelty
from restock.replay.store.store import Store

SAMPLE = Path(__file__).parents[1] / "sample_logs"
READ = "SELECT * FROM transitions ORDER BY md5_number_lower(transition_id::VARCHAR)"
NAMED = ("wheel_slip", "near_collision", "recovery", "blocked_aisle")
SHARES = (0.01, 0.05)


def main() -> int:
    parser = option_parser(__doc__, quick="up to 100,000 rows")
    parser.add_argument("store", nargs="?", help="a store; default: the sample logs")
    parser.add_argument("--rows", type=int, nargs="*", default=[100_000, 1_000_000, 10_000_000])
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        place = options.store or f"{folder}/store"
        if options.store is None:
            run_restock(["ingest", str(SAMPLE), "--store", place])
        with Store(place) as store:
            rows = store.sql(READ).to_arrow_table()
    ranks = list(rank(rows))
    sizes = [size for size in options.rows if not options.quick or size <= 100_000]
    growth = [grow(rows, size) for size in sizes]
    lines = [markdown(list(table[0]), [line.values() for line in table])
             for table in (ranks, growth) if table]  # fmt: skip
    return finish(options, {"ranks": ranks, "growth": growth}, [], "\n\n".join(lines).split("\n"))


def rank(rows: pa.Table) -> list[dict[str, object]]:
    """Return AUROC by condition, and what the top shares hold, of several references."""
    observation = np.stack(rows["observation"].to_numpy())
    standardised = (observation / np.maximum(observation.std(axis=0), 1e-6)).astype(np.float32)
    held = [set(conditions) for conditions in rows["conditions"].to_pylist()]
    return [
        score(f"{name}, {size:,}", held, of_reference(rows, values, size))
        for name, values, size in (
            ("as scaled by the task", observation, REFERENCE),
            ("as scaled by the task", observation, REFERENCE // 2),
            ("as scaled by the task", observation, 5 * REFERENCE),
            ("standardised", standardised, REFERENCE),
            ("standardised", standardised, 5 * REFERENCE),
        )
    ]


def of_reference(rows: pa.Table, observation: F32, size: int) -> F32:
    """Return the novelty of each row, (N,), by the first rows as the reference."""
    values = pa.FixedSizeListArray.from_arrays(observation.ravel(), observation.shape[1])
    given = pa.table({"observation": values[:size], "episode_id": rows["episode_id"][:size]})
    episodes = rows["episode_id"].combine_chunks()
    return Reference.of(given).compare(observation, episodes)[1]


def score(name: str, held: list[set[str]], novelty: F32) -> dict[str, object]:
    line: dict[str, object] = {"observation, reference": name}
    for condition in NAMED:
        named = np.array([condition in conditions for conditions in held])
        if named.any():
            line[condition.replace("_", " ")] = f"{auroc(novelty, named):.3f}"
    named = np.array([bool(conditions) for conditions in held])
    line["any"] = f"{auroc(novelty, named):.3f}"
    for share in SHARES:
        top = novelty > np.quantile(novelty, 1 - share)
        line[f"named in the top {share:.0%}"] = f"{named[top].mean():.0%}"
    return line


def auroc(novelty: F32, named: Bools) -> float:
    area = mannwhitneyu(novelty[named], novelty[~named]).statistic
    return float(area / (named.sum() * (~named).sum()))


def grow(rows: pa.Table, size: int) -> dict[str, object]:
    """Measure so many rows: the given ones, as often as it takes."""
    narrow = rows.select(["transition_id", "episode_id", "task_hash", "observation"])
    with duckdb.connect() as connection:
        connection.register("given", narrow)
        connection.execute(
            "CREATE VIEW transitions AS SELECT given.* REPLACE ("
            " (hash(transition_id, part) >> 1)::BIGINT AS transition_id,"
            " episode_id || part AS episode_id)"
            f" FROM range({-(-size // len(narrow))}) AS parts(part), given LIMIT {size}"
        )
        cpu, wall = time.process_time(), time.monotonic()
        table = read_novelty(connection)
    peak_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    return {
        "rows": f"{len(table):,}",
        "CPU s": f"{time.process_time() - cpu:.1f}",
        "s": f"{time.monotonic() - wall:.1f}",
        "peak of the process, GB": f"{peak_gb:.2f}",
    }


if __name__ == "__main__":
    raise SystemExit(main())
