"""Faults planted in one robot's logs of a fleet, and what `restock diagnose` makes of them.

    python benchmarks/planted_row_faults.py --out /tmp/faults --sets developed
    python benchmarks/planted_row_faults.py --out /tmp/faults            # what was left out, once

It records two fleets of four robots in the twin. The types on which limits are set, those of
`row_fault_types` and `used_types`, are planted in the first fleet, those of `left_out_types` in
the second; faults of all robots that leave missions out, in the sample logs, which have more. The
controls are both fleets and recordings of other missions, drivers, loads and floors, with nothing
planted.

A fault is *named* if a finding says what it is of and, if one robot has it, which robot. Findings
of another cause are a *wrong reason*; those that blame only robots without it are *opposite*.
"""

from __future__ import annotations

import re
import shutil
import sys
from collections import Counter
from functools import cache
from pathlib import Path
from unittest.mock import patch

import numpy as np
from harness import finish, markdown, option_parser, run_restock
from left_out_types import LEFT_OUT
from row_fault_types import DEVELOPED, DOSES, Draws, Fault, with_columns
from used_types import USED

from restock.ingest.pipeline import ingest
from restock.ingest.profile.profile import load_profile
from restock.ingest.steps import episodes as steps_module
from restock.ingest.steps.filling import Filling
from restock.ingest.store.writer import StoreWriter
from restock.ingest.task.task import Signals
from restock.train.judge.before_training import RowDiagnosis, diagnose_rows, open_rows
from restock.train.judge.fed_rows import FedRows, drive_twin
from restock.train.twin.floors.floors import open_floors
from restock.train.twin.floors.layout import DEFAULT

PROFILE = load_profile("warehouse_amr")
ROBOTS, FAULTY = ("amr-1", "amr-2", "amr-3", "amr-4"), "amr-2"
FLEETS = {"developed": 801, "left out": 861}  # the seed of the first robot
SETS = {"developed": (*DEVELOPED, *USED), "left out": LEFT_OUT}
OUTCOMES = ("named", "wrong reason", "missed", "opposite")
MOSTLY = {"slippery": "wheel_slip", "blocked": "blocked_aisle", "crowded": "near_collision"}
CONTROLS = {  # name: arguments of `restock twin record`
    **{f"plain{n}": ["--seed", str(900 + n)] for n in (1, 2, 3, 4)},
    **{
        f"{name}{n}": ["--seed", str(seed + n), "--conditions", f"nominal=.3,{kind}=.7"]
        for seed, (name, kind) in zip((910, 920, 930), MOSTLY.items(), strict=True)
        for n in (1, 2)
    },
    "operator": ["--seed", "941", "--policy", "operator"],
    "planner": ["--seed", "942", "--policy", "planner"],
    "random": ["--seed", "943", "--policy", "random"],
    "floors": ["--seed", "944", "--layouts", "generated:train"],
    "floors2": ["--seed", "945", "--layouts", "generated:test"],
    "payload": ["--seed", "946", "--perturbation", "payload"],
    "friction": ["--seed", "947", "--perturbation", "friction"],
}


def recorded(out: Path, name: str, flags: list[str]) -> Path:
    """Return a recording, made once."""
    path = out / f"{name}.mcap"
    if not path.exists():
        run_restock(["twin", "record", "--out", str(path), "--missions", "25", *flags])
    return path


def fleet(out: Path, first: int) -> dict[str, Path]:
    """Return the recordings of four robots, by robot."""
    return {
        robot: recorded(out, f"{robot}-{first}", ["--seed", str(first + n), "--tag",
                        f"robot={robot}", "--start", f"2026-03-0{n + 1}T08:00"])
        for n, robot in enumerate(ROBOTS)
    }  # fmt: skip


def stored(out: Path, name: str, paths: list[Path]) -> Path:
    """Return a store of recordings, made once."""
    store = out / name
    if not store.exists():
        run_restock(["ingest", *map(str, paths), "--store", str(store)])
    return store


def planting(fault: Fault, rng: Draws) -> type[Filling]:
    """Return a `Filling` that plants the fault before routes are looked up, or at the end."""

    class Planted(Filling):
        def _fill_scans(self) -> None:
            super()._fill_scans()
            if fault.signals is not None:
                fault.signals(self, rng)

        def fill(self) -> Signals:
            signals = super().fill()
            if fault.routed is not None:
                fault.routed(self, rng)
            return signals

    return Planted


def planted(fault: Fault, robots: dict[str, Path], healthy: Path, out: Path) -> Path:
    """Return a store of the fleet with the fault."""
    store, rng = out / "planted", np.random.default_rng(0)
    if store.exists():
        shutil.rmtree(store)
    writer, source = StoreWriter(store), StoreWriter(healthy)
    for row in source.live().to_pylist():
        robot = (
            row["tags"]["robot"] if isinstance(row["tags"], dict) else dict(row["tags"])["robot"]
        )
        manifest = source.live(row["recording_id"])
        has_it = fault.of_all or robot == FAULTY
        if has_it and (fault.signals or fault.routed):
            with patch.object(steps_module, "Filling", planting(fault, rng)):
                ingest(robots[robot], PROFILE, store=writer)
            continue
        rows = source.rows(row["recording_id"], row["ingest_id"])
        writer.write(manifest, fault.rows(rows, rng) if has_it and fault.rows else rows)
        if has_it and fault.again:
            other, copy = ("f" + row[name][1:] for name in ("recording_id", "ingest_id"))
            inside = rng.random(int(np.max(rows["episode_index"].to_numpy())) + 1) < fault.again
            rows = rows.filter(inside[rows["episode_index"].to_numpy()])
            episodes = [f"{other}/{index}" for index in rows["episode_index"].to_pylist()]
            named = {"recording_id": [other], "ingest_id": [copy]}
            again = with_columns(
                rows,
                **{name: values * len(rows) for name, values in named.items()},
                episode_id=episodes,
                transition_id=rows["transition_id"].to_numpy() ^ (1 << 55),
            )
            writer.write(with_columns(manifest, **named), again)
    return store


@cache
def twin() -> FedRows:
    return drive_twin(PROFILE.task, PROFILE.conditions)


def judged(store: Path) -> RowDiagnosis:
    opened = open_rows(store)
    return diagnose_rows(
        opened.rows, twin(), more=opened.checks, files=opened.files, floors=open_floors(DEFAULT)
    )


def outcome(fault: Fault, found: RowDiagnosis) -> str:
    said = [f"{one.cause}: {one.text}" for one in found.findings]
    right = [text for text in said if re.search(fault.right, text)]
    if any(fault.of_all or FAULTY in text for text in right):
        return "named"
    if not said:
        return "missed"
    sound = [robot for robot in ROBOTS if robot != FAULTY]
    blamed = [not fault.of_all and FAULTY not in text and any(r in text for r in sound)
              for text in said]  # fmt: skip
    return "opposite" if all(blamed) else "wrong reason"


def main() -> int:
    parser = option_parser(__doc__)
    parser.add_argument("--out", type=Path, required=True, help="where recordings and stores go")
    parser.add_argument(
        "--sets", default="left out,controls", help="of developed, left out, controls"
    )
    parser.add_argument("--doses", default=",".join(DOSES), help="in this order")
    parser.add_argument("--types", default="", help="only those with this in their name")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    details, lines, missed, totals = [], [], [], {}
    sample = stored(options.out, "sample", [Path(__file__).parents[1] / "sample_logs"])
    for name in options.sets.split(","):
        if name == "controls":
            continue
        robots = fleet(options.out, FLEETS[name])
        healthy = stored(options.out, f"fleet-{FLEETS[name]}", [*robots.values()])
        table: dict[str, dict[str, str]] = {one.type: {} for one in SETS[name]}
        doses = [DOSES[place % 3] for place in range(len(SETS[name]))]
        wanted = options.doses.split(",")
        chosen = [
            (fault, dose)
            for one in wanted
            for fault, dose in zip(SETS[name], doses, strict=True)
            if dose == one and options.types in fault.type
        ]
        for fault, dose in chosen:
            base = sample if fault.of_all and fault.rows else healthy
            found = judged(planted(fault, robots, base, options.out))
            what = outcome(fault, found)
            table[fault.type][dose] = f"{fault.dose}: {what}"
            said = [f"{one.cause}: {one.text}" for one in found.findings]
            details.append(
                {"set": name, "type": fault.type, "dose": fault.dose, "outcome": what, "said": said}
            )
            print(f"{what}: {fault.type}, {fault.dose}: {'; '.join(said)}", file=sys.stderr)
        counts = Counter(one["outcome"] for one in details if one["set"] == name)
        totals[name] = dict(counts)
        lines += [f"\n{name}: {dict(counts)}"]
        rows = [
            [kind, *(one.get(dose, "") for dose in DOSES)] for kind, one in table.items() if one
        ]
        lines += [markdown(["type", *DOSES], rows)]
        if name == "left out" and counts["named"] < 0.8 * counts.total():
            missed.append(f"{counts['named']} of {counts.total()} named, at least 80 % wanted")
        if counts["opposite"]:
            missed.append(f"{name}: {counts['opposite']} opposite, none wanted")
    if "controls" in options.sets:
        stores = {
            f"fleet-{first}": stored(
                options.out, f"fleet-{first}", [*fleet(options.out, first).values()]
            )
            for first in FLEETS.values()
        }
        stores["sample logs"] = sample
        for name, flags in CONTROLS.items():
            stores[name] = stored(options.out, name, [recorded(options.out, name, flags)])
        verdicts = {}
        for name, store in stores.items():
            found = judged(store)
            verdicts[name] = found.verdict
            said = [f"{one.cause}: {one.text}" for one in found.findings]
            unclear = [row.check for row in found.comparisons if row.suspicious]
            details.append(
                {"set": "controls", "logs": name, "outcome": found.verdict, "said": said}
            )
            print(f"{found.verdict}: {name}: {'; '.join(said or unclear)}", file=sys.stderr)
        healthy_ones = sum(verdict == "HEALTHY" for verdict in verdicts.values())
        totals["controls"] = dict(Counter(verdicts.values()))
        lines += [f"\ncontrols: {healthy_ones} of {len(verdicts)} healthy"]
        if healthy_ones < 0.95 * len(verdicts):
            missed.append(f"{healthy_ones} of {len(verdicts)} controls healthy, 95 % wanted")
    return finish(options, {"totals": totals, "runs": details}, missed, lines)


if __name__ == "__main__":
    sys.exit(main())
