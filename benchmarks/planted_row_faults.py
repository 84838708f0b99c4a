"""Faults planted in logs, and what `restock diagnose` makes of them.

    python benchmarks/planted_row_faults.py --out /tmp/row_faults sample_logs more_logs/*.mcap
    python benchmarks/planted_row_faults.py --out /tmp/row_faults sample_logs --unchanged

A fault is planted where its like arises: in the signals, between a recording's messages and the
observation, so that observations, actions, rewards and labels all agree with it, as with a wrong
profile or a wrong clock; or in the rows of a store, as by software that rewrites them. Doses are
shares of missions or rows, scales and steps. The recordings as they are must be healthy.

The limits were fixed on the types of TUNED and on healthy logs; those of LEFT_OUT were planted
once, when the limits stood, and those of LATER once, when it was changed what rows on ice count.

`--unchanged` records the UNCHANGED logs, which nothing is planted in, and judges those.
`--missions` takes each mission for a recording of its own, as of a fleet that logs so, and the
recordings that they are from for its robots: `tagged`; `untagged`, one robot after the other; or
`mixed`, untagged and in random order.
"""

from __future__ import annotations

import re
import shutil
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
import pyarrow as pa
from harness import finish, markdown, once, option_parser, run_restock

from restock.ingest.containers.open_recording import recordings_in
from restock.ingest.pipeline import ingest
from restock.ingest.profile.profile import load_profile
from restock.ingest.steps import episodes as steps_module
from restock.ingest.steps.filling import Filling
from restock.ingest.store.writer import StoreWriter
from restock.ingest.task.task import Signals
from restock.train.judge.before_training import diagnose_rows, drive_twin, open_rows
from restock.train.judge.causes import Finding
from restock.train.judge.fed_rows import FedRows

PROFILE = load_profile("warehouse_amr")
STRATUM = "blocked_aisle"
Signalled = Callable[[Filling, np.random.Generator], None]
Rowed = Callable[[pa.Table, np.random.Generator], pa.Table]


class Fault(NamedTuple):
    """One type at one dose: where it is planted, and the findings that are right (a pattern)."""

    type: str
    dose: str
    right: str
    signals: Signalled | None = None
    rows: Rowed | None = None
    routed: Signalled | None = None  # planted when the signals are whole
    again: float = 0.0  # share of the recordings written once more under another id


# -- in the signals ---------------------------------------------------------------------------


def missions(filling: Filling, share: float, rng: np.random.Generator) -> np.ndarray:
    """Return the ticks (T,) of a share of the missions, which pauses of the recording divide."""
    number = np.cumsum(np.diff(filling.tick_ns, prepend=filling.tick_ns[:1]) > 2 * 10**9)
    chosen = rng.permutation(int(number.max()) + 1)
    return np.isin(number, chosen[: max(round(share * len(chosen)), 1)])


def scale(*names: str, by: float, share: float = 1.0) -> Signalled:
    def plant(filling: Filling, rng: np.random.Generator) -> None:
        inside = missions(filling, share, rng)
        for name in names:
            column = filling.signals[name]
            filling.signals[name] = np.where(inside, column * by, column)

    return plant


def in_recordings(share: float, plant: Signalled) -> Signalled:
    """Return a fault planted in a share of the recordings, as from one robot of a fleet."""

    def planted(filling: Filling, rng: np.random.Generator) -> None:
        if rng.random() < share:
            plant(filling, rng)

    return planted


def later(*names: str, steps: int, share: float = 1.0) -> Signalled:
    def plant(filling: Filling, rng: np.random.Generator) -> None:
        inside = missions(filling, share, rng)
        for name in names:
            column = filling.signals[name]
            moved = np.concatenate([np.repeat(column[:1], steps), column[:-steps]])
            filling.signals[name] = np.where(inside, moved, column)

    return plant


def permuted(cycle: int) -> Signalled:
    """Commands of another table of actions: each is the one `cycle` places on."""

    def plant(filling: Filling, rng: np.random.Generator) -> None:
        table = np.asarray(filling.task.actions)
        names = "command_speed_mps", "command_yaw_rate_radps"
        given = np.stack([filling.signals[name] for name in names], axis=1)
        nearest = np.abs(given[:, None] - table).sum(axis=2).argmin(axis=1)
        moved = np.where(nearest > 0, 1 + (nearest - 1 + cycle) % (len(table) - 1), 0)
        filling.signals[names[0]], filling.signals[names[1]] = table[moved].T

    return plant


def lost(share: float) -> Signalled:
    """Commands that did not arrive: the one before stands."""

    def plant(filling: Filling, rng: np.random.Generator) -> None:
        gone = rng.random(len(filling.tick_ns)) < share
        gone[0] = False
        held = np.maximum.accumulate(np.where(gone, 0, np.arange(len(gone))))
        for name in ("command_speed_mps", "command_yaw_rate_radps"):
            filling.signals[name] = filling.signals[name][held]

    return plant


def lidar(change: Callable[[np.ndarray], np.ndarray], share: float = 1.0) -> Signalled:
    def plant(filling: Filling, rng: np.random.Generator) -> None:
        inside = missions(filling, share, rng)
        seen = filling.signals["sector_clearance_m"]
        changed = np.where(inside[:, None], change(seen), seen)
        filling.signals |= {"sector_clearance_m": changed, "clearance_m": changed.min(axis=1)}

    return plant


def shaken(by_m: float) -> Signalled:
    def plant(filling: Filling, rng: np.random.Generator) -> None:
        for name in ("pose_x_m", "pose_y_m"):
            column = filling.signals[name]
            filling.signals[name] = column + rng.normal(0, by_m, len(column))

    return plant


POSE = ("pose_x_m", "pose_y_m", "pose_yaw_rad")
COMMAND = ("command_speed_mps", "command_yaw_rate_radps")
WAYPOINTS = ("waypoint_near_y_m", "waypoint_far_y_m")

# -- in the rows ------------------------------------------------------------------------------


def with_columns(rows: pa.Table, **columns: object) -> pa.Table:
    for name, values in columns.items():
        at = rows.schema.get_field_index(name)
        field = rows.schema.field(at)
        column = values if isinstance(values, pa.ChunkedArray) else pa.array(values, field.type)
        rows = rows.set_column(at, field, column)
    return rows


def rewards(by: float, share: float = 1.0) -> Rowed:
    def plant(rows: pa.Table, rng: np.random.Generator) -> pa.Table:
        reward = rows["reward"].to_numpy()
        inside = rng.random(len(reward)) < share
        return with_columns(rows, reward=np.where(inside, by * reward, reward))

    return plant


def rewards_of_others(rows: pa.Table, rng: np.random.Generator) -> pa.Table:
    return with_columns(rows, reward=np.roll(rows["reward"].to_numpy(), 1))


def unended(share: float) -> Rowed:
    def plant(rows: pa.Table, rng: np.random.Generator) -> pa.Table:
        ended = rows["terminated"].to_numpy()
        return with_columns(rows, terminated=ended & (rng.random(len(ended)) >= share))

    return plant


def apart(share: float) -> Rowed:
    def plant(rows: pa.Table, rng: np.random.Generator) -> pa.Table:
        order = np.arange(len(rows))
        inside = np.flatnonzero(rng.random(len(rows)) < share)
        order[inside] = rng.permutation(inside)
        return with_columns(rows, next_observation=rows["next_observation"].take(order))

    return plant


def ahead(share: float) -> Rowed:
    def plant(rows: pa.Table, rng: np.random.Generator) -> pa.Table:
        episode = rows["episode_index"].to_numpy()
        inside = (rng.random(int(episode.max()) + 1) < share)[episode]
        both = pa.chunked_array([*rows["observation"].chunks, *rows["next_observation"].chunks])
        order = np.arange(len(rows)) + np.where(inside, len(rows), 0)
        return with_columns(rows, observation=both.take(order))

    return plant


def mislabelled(share: float) -> Rowed:
    def plant(rows: pa.Table, rng: np.random.Generator) -> pa.Table:
        held = rows["conditions"].to_pylist()
        named = rows["condition"].to_pylist()
        inside = [i for i, names in enumerate(held) if STRATUM in names]
        plain = [i for i, names in enumerate(held) if not names]
        wrong = rng.permutation(inside)[: round(share * len(inside))].tolist()
        for index in wrong:
            held[index] = [name for name in held[index] if name != STRATUM]
            named[index] = held[index][0] if held[index] else "nominal"
        for index in rng.permutation(plain)[: len(wrong)].tolist():
            held[index], named[index] = [STRATUM], STRATUM
        return with_columns(rows, conditions=held, condition=named)

    return plant


TURN, SPIN = "command_yaw_rate_radps", "gyro_yaw_rate_radps"
WHEELS = ("wheel_speed_mps", "wheel_yaw_rate_radps")
MIRRORED, SHIFTED = "ACTIONS_(MIRRORED|MIXED)", "ACTIONS_SHIFTED"
REWARD, ENDS = "REWARD_", "TERMINATIONS_"
TUNED = [
    *(Fault("left and right swapped", f"{s:.0%} of missions", MIRRORED, scale(TURN, by=-1, share=s))
      for s in (0.25, 0.5, 1.0)),
    *(Fault("commands late", f"{n} steps", SHIFTED, later(*COMMAND, steps=n)) for n in (1, 2, 3)),
    Fault("commands late", "2 steps in 50% of missions", SHIFTED,
          later(*COMMAND, steps=2, share=0.5)),
    *(Fault("rewards scaled", f"by {by:g}", REWARD, rows=rewards(by)) for by in (2, 10, 0.5)),
    Fault("rewards scaled", "by 10 in 25% of rows", REWARD, rows=rewards(10, 0.25)),
    Fault("rewards of the row before", "all", REWARD, rows=rewards_of_others),
    *(Fault("terminations lost", f"{s:.0%}", ENDS, rows=unended(s)) for s in (0.5, 1.0)),
    *(Fault("next observations of other rows", f"{s:.0%}", "ROWS_APART", rows=apart(s))
      for s in (0.1, 1.0)),
    *(Fault("observations of the step after", f"{s:.0%} of episodes", "FUTURE_", rows=ahead(s))
      for s in (0.25, 1.0)),
    Fault("gyroscope in degrees", "all", "SENSOR_SCALED.*gyro", scale(SPIN, by=180 / np.pi)),
    Fault("recordings twice", "all", "EPISODES_REPEATED", again=1.0),
]  # fmt: skip
LEFT_OUT = [
    *(Fault("labels wrong", f"{s:.0%} of {STRATUM}", "LABELS_WRONG", rows=mislabelled(s))
      for s in (0.1, 0.4)),
    *(Fault("wheels scaled", f"by {by:g}", "SENSOR_SCALED.*wheels", scale(*WHEELS, by=by))
      for by in (1.3, 0.7, 3.6)),
    *(Fault("lidar mirrored", f"{s:.0%} of missions", "SENSOR_.*lidar",
            lidar(lambda seen: seen[:, ::-1], s))
      for s in (0.5, 1.0)),
    *(Fault("lidar turned", f"{10 * n} degrees", "LIDAR_TURNED",
            lidar(lambda seen, n=n: np.roll(seen, n, axis=1)))
      for n in (3, 9, 18)),
    Fault("lidar sees nothing", "all", "VALUES_.*clearances",
          lidar(lambda seen: np.full_like(seen, 4.0))),
    *(Fault("pose late", f"{n} steps", "SENSOR_SHIFTED.*pose", later(*POSE, steps=n))
      for n in (1, 2, 5)),
    *(Fault("pose shaken", f"by {by:g} m", "UNLIKE_TWIN.*pose", shaken(by)) for by in (0.05, 0.2)),
    *(Fault("actions of another table", f"{n} places on", "ACTIONS_(PERMUTED|MIXED)", permuted(n))
      for n in (1, 3)),
    *(Fault("commands lost", f"{s:.0%}", "(ACTIONS_|UNLIKE_TWIN.*action)", lost(s))
      for s in (0.3, 0.6)),
    Fault("waypoints mirrored", "all", "SENSOR_MIRRORED.*plan", routed=scale(*WAYPOINTS, by=-1)),
]  # fmt: skip
LATER = [
    Fault("gyroscope reversed", "all", "SENSOR_MIRRORED.*gyro", scale(SPIN, by=-1)),
    Fault("gyroscope reversed", "in 50% of recordings", "gyro",
          in_recordings(0.5, scale(SPIN, by=-1))),
    Fault("gyroscope scaled", "by 2 in 50% of recordings", "gyro",
          in_recordings(0.5, scale(SPIN, by=2))),
    Fault("wheels scaled", "by 0.7 in 50% of recordings", "wheels",
          in_recordings(0.5, scale(*WHEELS, by=0.7))),
    Fault("commands scaled", "by 0.5", "COMMAND_SCALED", scale(*COMMAND, by=0.5)),
    Fault("wheels late", "2 steps", "SENSOR_SHIFTED.*wheels", later(*WHEELS, steps=2)),
    Fault("lidar halved", "all", "lidar|clearances", lidar(lambda seen: 0.5 * seen)),
]  # fmt: skip
NOTHING = Fault("nothing", "", "")
SETS = {"healthy": [NOTHING], "tuned": TUNED, "left out": LEFT_OUT, "later": LATER}
MOSTLY = {"slippery": "wheel_slip", "blocked": "blocked_aisle", "crowded": "near_collision"}
UNCHANGED = {  # name: arguments of `restock twin record`
    **{f"plain{n}": ("25", 700 + n, ()) for n in range(1, 7)},
    **{
        f"{name}{n}": ("30", seed + n, ("--conditions", f"nominal=.3,{kind}=.7"))
        for seed, (name, kind) in zip((710, 720, 730), MOSTLY.items(), strict=True)
        for n in (1, 2)
    },
    "operator": ("25", 741, ("--policy", "operator")),
    "planner": ("25", 742, ("--policy", "planner")),
    "random": ("25", 743, ("--policy", "random")),
    "floors": ("25", 744, ("--layouts", "generated:train")),
    "floors2": ("25", 745, ("--layouts", "generated:test")),
    "payload": ("25", 746, ("--perturbation", "payload")),
    "friction": ("25", 747, ("--perturbation", "friction")),
}
MISSIONS = ("tagged", "untagged", "mixed")
OUTCOMES = ("named", "named otherwise", "UNDETERMINED", "HEALTHY")


def planting(fault: Fault, rng: np.random.Generator) -> type[Filling]:
    """Return a `Filling` that plants the fault before routes are looked up, or at the end."""

    class Planted(Filling):
        def _scan(self) -> None:
            super()._scan()
            if fault.signals is not None:
                fault.signals(self, rng)

        def fill(self) -> Signals:
            signals = super().fill()
            if fault.routed is not None:
                fault.routed(self, rng)
            return signals

    return Planted


def plant(logs: Path, fault: Fault, out: Path) -> Path:
    """Return a store of the recordings with the fault, made once."""
    store = out / re.sub(r"\W+", "_", f"{logs.stem}-{fault.type}-{fault.dose}")
    mark = store.with_name(f"{store.name}.json")
    once(mark, [str(logs.resolve())], lambda: _plant(logs, fault, store))
    return store


def _plant(logs: Path, fault: Fault, store: Path) -> None:
    """From the first recording on: draws go on from one to the next."""
    if store.exists():
        shutil.rmtree(store)
    rng = np.random.default_rng(0)
    if fault.rows or fault.again:
        healthy = plant(logs, NOTHING, store.parent)
        rewrite(StoreWriter(healthy), StoreWriter(store), fault, rng)
        return
    with patch.object(steps_module, "Filling", planting(fault, rng)):
        for path in recordings_in(logs):
            ingest(path, PROFILE, store=StoreWriter(store))


def rewrite(
    source: StoreWriter, target: StoreWriter, fault: Fault, rng: np.random.Generator
) -> None:
    for row in source.live().to_pylist():
        rows = source.rows(row["recording_id"], row["ingest_id"])
        manifest = source.live(row["recording_id"])
        target.write(manifest, fault.rows(rows, rng) if fault.rows else rows)
        if rng.random() < fault.again:
            other, copy = ("f" + row[name][1:] for name in ("recording_id", "ingest_id"))
            episodes = [f"{other}/{index}" for index in rows["episode_index"].to_pylist()]
            named = {"recording_id": [other], "ingest_id": [copy]}
            copied = with_columns(
                rows,
                **{name: values * len(rows) for name, values in named.items()},
                episode_id=episodes,
                transition_id=rows["transition_id"].to_numpy() ^ (1 << 55),
            )
            target.write(with_columns(manifest, **named), copied)


def unchanged(out: Path) -> list[Path]:
    """Return recordings without a fault: all kinds of missions, drivers, floors and loads.

    They are made once.
    """
    paths = []
    for name, (missions, seed, flags) in UNCHANGED.items():
        paths.append(out / f"{name}.mcap")
        if not paths[-1].exists():
            where = ["--out", str(paths[-1]), "--missions", missions, "--seed", str(seed)]
            run_restock(["twin", "record", *where, *flags])
    return paths


def by_mission(rows: FedRows, how: str) -> FedRows:
    """Split rows into recordings, one per mission."""
    pairs = zip(rows.recording.tolist(), rows.episode.tolist(), strict=True)
    missions = np.array([f"{recording}-{episode:04d}" for recording, episode in pairs])
    robot = rows.recording if how == "tagged" else np.full(len(rows), "")
    order = np.arange(int(rows.episode.max()) + 1)
    if how == "mixed":
        order = np.random.default_rng(3).permutation(order)
    return replace(rows, recording=missions, robot=robot, logged_ns=order[rows.episode])


def outcome(fault: Fault, verdict: str, findings: list[Finding]) -> str:
    if verdict != "BUFFER":
        return verdict
    said = [f"{one.cause} {one.text}" for one in findings]
    named = fault.right and any(re.search(fault.right, text) for text in said)
    return "named" if named else "named otherwise"


def main() -> int:
    parser = option_parser(__doc__)
    parser.add_argument("logs", type=Path, nargs="+", help="recordings of this robot")
    parser.add_argument("--out", type=Path, required=True, help="where stores go")
    parser.add_argument("--sets", default=",".join(SETS), help="of healthy, tuned, left out")
    parser.add_argument("--types", default="", help="only those with this in their name")
    parser.add_argument("--unchanged", action="store_true", help="only unchanged logs, and more")
    parser.add_argument("--missions", choices=MISSIONS, help="each as a recording")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    if options.unchanged:
        options.sets, options.logs = "healthy", [*options.logs, *unchanged(options.out)]
    twin = drive_twin(PROFILE.task, PROFILE.conditions)
    counts: dict[str, dict[tuple[str, str], Counter[str]]] = {}
    details = []
    for name in options.sets.split(","):
        table = counts.setdefault(name, {})
        for fault in (one for one in SETS[name] if options.types in one.type):
            for logs in options.logs:
                opened = open_rows(plant(logs, fault, options.out))
                rows = opened.rows
                if options.missions:
                    rows = by_mission(rows, options.missions)
                found = diagnose_rows(rows, twin, more=opened.comparisons)
                what = outcome(fault, found.verdict, found.findings)
                table.setdefault((fault.type, fault.dose), Counter())[what] += 1
                said = [f"{one.cause}: {one.text}" for one in found.findings]
                unclear = [row.check for row in found.comparisons if row.suspicious]
                details.append(
                    {"set": name, "type": fault.type, "dose": fault.dose, "logs": logs.stem}
                    | {"outcome": what, "findings": said, "undecided": unclear}
                )
                if not options.json:
                    print(f"{fault.type}, {fault.dose}, {logs.stem}: {what}; {said or unclear}")
    lines, missed, totals = [], [], {}
    for name, table in counts.items():
        total: Counter[str] = sum(table.values(), Counter())
        totals[name] = dict(total)
        rows = [[*key, *(found[o] or "" for o in OUTCOMES)] for key, found in table.items()]
        lines += [f"\n{name}", markdown(["planted", "dose", *OUTCOMES], rows)]
        right, least = (total["HEALTHY"], 0.95) if name == "healthy" else (total["named"], 0.8)
        if right < least * total.total():
            missed.append(f"{name}: {right} of {total.total()} right, at least {least:.0%} wanted")
    return finish(options, {"totals": totals, "runs": details}, missed, lines)


if __name__ == "__main__":
    sys.exit(main())
