"""Hashes of what the sample logs become: transitions, a panel, a run of seed 0, its evaluation.

    PYTHONPATH=tests python -m support.goldens    # write tests/golden/sample_logs.json again

A change that is not meant to change values must leave them alone. A hash is of one column, so that
a column can be added or removed without touching the others. Sums of floats are rounded
differently by other processors and libraries: hashes, and all tables of the run, are compared on
the machine that `made_on` describes, and numbers of ingested and mixed rows everywhere.
"""

import hashlib
import json
import platform
import tempfile
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from restock import native
from support.paths import ROOT

KEPT = ROOT / "tests/golden/sample_logs.json"
STEPS = 3_000
# Clocks of the machine, ages in wall time, random ids, paths and the commit.
NOT_COMPARED = {"wall_s", "env_steps_per_s", "updates_per_s", "ingest_id", "restock_version"}
NOT_COMPARED |= {"source_file", "p50", "p90", "p99", "age_days"}
Hashes = dict[str, dict[str, str | int]]


def made_on() -> dict[str, str]:
    """Return the processor and the libraries that the low bits of floats depend on."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    libraries = {name: version(name) for name in ("numpy", "torch", "mujoco", "duckdb")}
    return {"processor": (models or [platform.machine()])[0], **libraries}


def hash_columns(table: pa.Table) -> dict[str, str | int]:
    """Return the number of rows and a hash of the values of each column."""
    hashes: dict[str, str | int] = {"number of rows": table.num_rows}
    for name in sorted(set(table.column_names) - NOT_COMPARED):
        values = table[name].to_pylist()
        hashes[name] = hashlib.sha256(repr(values).encode()).hexdigest()[:16]
    return hashes


def compute_hashes(folder: Path, *, trains: bool = True) -> Hashes:
    """Ingest, mix, train and evaluate in `folder`, and hash the tables that come of it."""
    from restock.cli import main
    from restock.replay import Store

    store, panel, run = (str(folder / name) for name in ("store", "panel", "run"))
    steps = f"schedule.env_steps={STEPS}"
    logs = sorted((ROOT / "sample_logs").glob("amr_*"))
    main(["ingest", *map(str, logs), "--store", store, "--profile", "warehouse_amr"])
    main(["mix", store, "--mixture", "coverage", "--out", panel])
    if trains:
        main(["train", "--panel", panel, "--out", run, "--set", "seed=0", "--set", steps])
        main(["eval", run, "--episodes", "4", "--perturbations", "none,friction"])

    with Store(store) as opened:
        rows = opened.sql("FROM transitions ORDER BY recording_id, step_index").arrow()
    hashes: Hashes = {"transitions": hash_columns(pa.table(rows))}
    hashes["panel"] = _hash_panel(Path(panel))
    for path in sorted(Path(run).rglob("*.parquet")):
        hashes[f"run/{path.relative_to(run)}"] = hash_columns(pq.read_table(path))
    return hashes


def _hash_panel(panel: Path) -> dict[str, str | int]:
    header: dict[str, Any] = json.loads((panel / "panel.json").read_text())
    packed = np.fromfile(panel / "rows.f32", "<f4")
    return {
        "panel.json rows": header["rows"],
        "rows.f32": hashlib.sha256(packed.tobytes()).hexdigest()[:16],
        **hash_columns(pq.read_table(panel / "meta.parquet")),
    }


if __name__ == "__main__":
    native.IS_USED = False
    with tempfile.TemporaryDirectory() as folder:
        hashes = compute_hashes(Path(folder))
    KEPT.parent.mkdir(exist_ok=True)
    KEPT.write_text(json.dumps({"made_on": made_on(), "hashes": hashes}, indent=1) + "\n")
