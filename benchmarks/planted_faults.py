"""Faults planted in training, and what `restock diagnose` makes of them: a confusion table.

    python benchmarks/planted_faults.py --out /tmp/faults --seeds 3

Three faults of the buffer, all in the blocked aisles, which the twin's training episodes then lack:
their logged rows are removed; stale (next observations and rewards of other rows of the stratum);
or mislabelled (the label stands on nominal rows). Four of the target and the optimizer: frozen,
too slow, no target at all (tau 1), learning rate a thousand times too high. Runs are kept in --out
and taken up where they are, so that a table can be made again without training again.
"""

from __future__ import annotations

import shutil
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pyarrow as pa
from harness import finish, markdown, option_parser, run_restock
from twin_runs import trained

from restock.ingest.store.writer import StoreWriter
from restock.train.judge.diagnose import diagnose
from restock.train.run.run import Run

STRATUM = "blocked_aisle"
# Of the training episodes: none in the stratum, the rest as a run has them by default.
LACKING = "env.conditions={nominal=0.4, wheel_slip=0.2, near_collision=0.2, blocked_aisle=0}"
BUFFER, TARGET = {"BUFFER", "BOTH"}, {"TARGET", "BOTH", "DIVERGENCE"}
CAUSES = ["HEALTHY", "BUFFER", "TARGET", "BOTH", "DIVERGENCE", "UNDETERMINED"]
# fault -> the causes that are right, and the settings that plant it
FAULTS: dict[str, tuple[set[str], list[str]]] = {
    "healthy": ({"HEALTHY"}, []),
    "stratum removed": (BUFFER, [LACKING]),
    "stratum stale": (BUFFER, [LACKING]),
    "stratum mislabelled": (BUFFER, [LACKING]),
    "target frozen": (TARGET, ["target={rule='hard', every=1000000}"]),
    "target too slow": (TARGET, ["target={rule='polyak', tau=0.00003}"]),
    "target too fast": (TARGET, ["target={rule='polyak', tau=1.0}"]),
    "learning rate too high": (TARGET, ["optimizer.learning_rate=0.3"]),
}
LOGGED = "stratum"  # the first word of faults of the logs
SETTINGS = {
    "schedule.env_steps": 32_000,
    "schedule.offline_updates": 1_000,
    "schedule.warmup_env_steps": 1_000,
    "schedule.updates_per_env_step": 0.25,
    "evaluation.every_env_steps": 5_000,
    "evaluation.episodes": 6,
    "epsilon.steps": 8_000,
    "optimizer.learning_rate": 0.0003,
    "record.every_updates": 250,
    "record.trackers": "[]",
}


def plant(clean: Path, faulty: Path, fault: str) -> None:
    """Write a store with the fault in its rows."""
    rng = np.random.default_rng(0)
    source, writer = StoreWriter(clean), StoreWriter(faulty)
    for row in source.live().to_pylist():
        rows = source.rows(row["recording_id"], row["ingest_id"])
        labels = rows["conditions"].to_pylist()
        names = np.array(rows["condition"].to_pylist(), object)
        inside = np.array([STRATUM in some for some in labels]) | (names == STRATUM)
        if fault == "stratum removed":
            rows = rows.filter(pa.array(~inside))
        elif fault == "stratum stale":
            order = np.arange(len(rows))
            order[inside] = rng.permutation(order[inside])
            for column in ("next_observation", "reward", "terminated"):
                at = rows.schema.get_field_index(column)
                rows = rows.set_column(at, rows.schema.field(at), rows[column].take(order))
        elif fault == "stratum mislabelled":
            nominal = np.flatnonzero(names == "nominal")
            chosen = rng.choice(nominal, min(int(inside.sum()), len(nominal)), replace=False)
            names[inside], names[chosen] = "nominal", STRATUM
            labels = [[n for n in some if n != STRATUM] for some in labels]
            for index in chosen:
                labels[index] = [STRATUM]
            for column, values in (("condition", names.tolist()), ("conditions", labels)):
                at = rows.schema.get_field_index(column)
                field = rows.schema.field(at)
                rows = rows.set_column(at, field, pa.array(values, field.type))
        manifest = source.live(row["recording_id"])
        writer.write(manifest, rows)


def panel_for(fault: str, out: Path) -> Path:
    """Return the panel that a fault trains on, made once."""
    clean, panel = out / "clean", out / "panels" / fault.replace(" ", "_")
    logs = Path(__file__).parents[1] / "sample_logs"
    run_restock(["ingest", str(logs), "--store", str(clean)])  # skips what it has
    if not panel.exists():
        store = clean
        if fault.startswith(LOGGED):
            store = out / "stores" / fault.replace(" ", "_")
            if store.exists():  # cut, or there would be the panel
                shutil.rmtree(store)
            plant(clean, store, fault)
        panel.parent.mkdir(exist_ok=True)
        run_restock(["mix", str(store), "--mixture", "coverage", "--out", str(panel)])
    return panel


def run_for(fault: str, seed: int, out: Path) -> Run:
    """Return a run with the fault; train it if it is missing."""
    panel = panel_for(fault if fault.startswith(LOGGED) else "healthy", out)
    settings = [f"{key}={value}" for key, value in SETTINGS.items()] + FAULTS[fault][1]
    path = out / "runs" / f"{fault.replace(' ', '_')}-{seed}"
    return trained(path, [*settings, f"seed={seed}"], panel)


def main() -> int:
    parser = option_parser(__doc__)
    parser.add_argument("--out", type=Path, required=True, help="where stores, panels and runs go")
    parser.add_argument("--seeds", type=int, default=3, help="how many")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--faults", default=",".join(FAULTS), help="comma-separated")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    table: dict[str, dict[str, int]] = {}
    right = opposite = total = 0
    for fault in options.faults.split(","):
        expected = FAULTS[fault][0]
        causes = [diagnose([run_for(fault, seed, options.out)]).cause for seed in seeds]
        table[fault] = dict(Counter(causes))
        total += len(causes)
        right += sum(cause == "UNDETERMINED" or cause in expected for cause in causes)
        of_target = expected <= TARGET or fault == "healthy"
        wrong = BUFFER - TARGET if of_target else TARGET - BUFFER
        opposite += sum(cause in wrong for cause in causes)
    rows = [[fault, *(counts.get(c, "") for c in CAUSES)] for fault, counts in table.items()]
    verdict = f"{right} of {total} named right or UNDETERMINED; {opposite} named the opposite"
    missed = [f"{verdict}; at least 90 %, none opposite"] if right < 0.9 * total or opposite else []
    answer = {"table": table, "right": right, "opposite": opposite, "runs": total}
    return finish(options, answer, missed, [markdown(["planted", *CAUSES], rows), f"\n{verdict}"])


if __name__ == "__main__":
    sys.exit(main())
