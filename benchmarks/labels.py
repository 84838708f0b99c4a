"""Labels against the truth, on fresh logs of the twin's stand-in: by step and by event.

    python benchmarks/labels.py --cache FOLDER [--part held-out] [--minutes 24] [--quick]

Records logs of seeds that no rule was set on, on the default floor and on `generated:test` floors
(`--part development`: the seeds and `generated:train` floors that the rules were set on), ingests
them, and prints precision and recall of each condition with 95 % intervals, the share that is too
near to call, the reliability of the probabilities, and `bound`: what a network of two layers
reaches that saw the development logs, all stored signals of 5 steps before to 4 after (`pre`
conditions: 12 before) and the truth. What is in FOLDER is not recorded again; labels follow the
rules as they are now.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from harness import finish, markdown, option_parser, run_restock

from restock.arrays import F32, Bools
from restock.ingest.profile.profile import load_profile
from restock.ingest.store.episode_rows import episode_ends
from restock.ingest.store.writer import StoreWriter
from restock.ingest.task.label_scores import LabelScore, pooled, score, true_names
from restock.replay.store.label_quality import LabelQuality, label_quality, reliability
from restock.replay.store.store import Store
from restock.train.twin.recording.recorder import RecordingPlan, record

SEEDS = {
    "development": {"default": range(101, 107), "generated:train": range(111, 119)},
    "held-out": {"default": range(901, 907), "generated:test": range(911, 917)},
}
TARGETS = {"event": 0.9, "step": 0.85}
BACK = {"pre": 12, "post": 4}
AHEAD = {"pre": 0, "post": 3}
EPOCHS, BATCH, WIDTH = 12, 512, 128
HOLDS, CLEAR, NEAR_STEPS = 0.4, 0.7, 2  # of the bound's probabilities: as the shipped rules hold on


def main() -> int:
    parser = option_parser(__doc__, quick="two logs of 6 minutes each, no bound")
    parser.add_argument(
        "--cache", type=Path, required=True, help="folder for recordings and stores"
    )
    parser.add_argument("--part", choices=sorted(SEEDS), default="held-out")
    parser.add_argument("--minutes", type=float, default=24.0, help="of each log")
    parser.add_argument("--no-bound", action="store_true", help="train no network")
    options = parser.parse_args()
    if options.quick:
        options.minutes = 6.0
    trained = not (options.quick or options.no_bound)
    parts = sorted({"development", options.part}) if trained else [options.part]
    stores = {
        (part, floors): stored(options.cache, floors, list(seeds)[: 2 if options.quick else None],
                               options.minutes)
        for part in parts
        for floors, seeds in SEEDS[part].items()
    }  # fmt: skip
    measured = {key: path for key, path in stores.items() if key[0] == options.part}
    bound = bounds(stores, options.part) if trained else {}
    lines: list[str] = []
    figures: dict[str, Any] = {}
    missed: list[str] = []
    for (_, floors), path in measured.items():
        with Store(path) as store:
            found = label_quality(store)
            bins = reliability(store).to_pylist()
        lines += [f"\n{options.part}, floors {floors}:\n", table(found, bound.get(floors, {}))]
        lines += ["", reliability_table(bins)]
        figures[floors] = {one.score.condition: vars(one.score) for one in found}
        missed += [miss for one in found for miss in misses(floors, one)]
    return finish(options, figures, missed, lines)


def stored(cache: Path, floors: str, seeds: Sequence[int], minutes: float) -> Path:
    """The store of these logs, recorded and ingested where they are not, labelled as of now."""
    cache.mkdir(parents=True, exist_ok=True)
    name = floors.replace(":", "_")
    store = cache / f"{name}_{seeds[0]}_{minutes:g}"
    for seed in seeds:
        log = cache / f"{name}_{seed}_{minutes:g}.mcap"
        if not log.exists():
            print(f"recording {log.name}", file=sys.stderr)
            record(log, RecordingPlan(minutes=minutes, seed=seed, layouts=floors))
        run_restock(["ingest", str(log), "--store", str(store)])
    run_restock(["label", str(store)])
    return store


def table(found: Sequence[LabelQuality], bound: Mapping[str, LabelScore]) -> str:
    """As the docs have it."""
    header = ["condition", "true steps", "precision", "recall", "true events", "event precision",
              "event recall", "uncertain", "bound: steps", "bound: events"]  # fmt: skip
    rows = []
    for one in found:
        best = bound.get(one.score.condition)
        shares = [
            f"{share.value:.2f} ({share.low:.2f} to {share.high:.2f})"
            for share in (one.precision, one.recall, one.event_precision, one.event_recall)
        ]
        rows.append(
            [
                f"`{one.score.condition}`",
                one.score.support,
                *shares[:2],
                one.score.event_support,
                *shares[2:],
                f"{one.uncertain or 0:.1%}",
                _pair(best.precision, best.recall) if best else "",
                _pair(best.event_precision, best.event_recall) if best else "",
            ]
        )
    return markdown(header, rows)


def _pair(precision: float | None, recall: float | None) -> str:
    return f"{precision or 0:.2f} / {recall or 0:.2f}"


def reliability_table(bins: Sequence[Mapping[str, Any]]) -> str:
    """A row a condition, a column a tenth of probability: the share that is true."""
    names = sorted({row["condition"] for row in bins})
    told = {(row["condition"], round(row["from_probability"] * 10)): row for row in bins}
    rows = [
        [f"`{name}`", *(f"{told[name, tenth]['true_share']:.2f} of {told[name, tenth]['known']:,}"
                        if (name, tenth) in told else "" for tenth in range(10))]
        for name in names
    ]  # fmt: skip
    return markdown(["probability", *(f"{tenth / 10:g} to {tenth / 10 + 0.1:.1f}"
                                      for tenth in range(10))], rows)  # fmt: skip


def misses(floors: str, one: LabelQuality) -> list[str]:
    """What of a condition is below its target."""
    shares = {
        "step": (one.score.precision, one.score.recall),
        "event": (one.score.event_precision, one.score.event_recall),
    }
    return [
        f"{floors}: {one.score.condition}: {kind} {name} {value or 0:.2f}, target {TARGETS[kind]}"
        for kind, values in shares.items()
        for name, value in zip(("precision", "recall"), values, strict=True)
        if (value or 0) < TARGETS[kind]
    ]


# -- the bound --------------------------------------------------------------------------------


def bounds(stores: Mapping[tuple[str, str], Path], part: str) -> dict[str, dict[str, LabelScore]]:
    """Floors -> condition -> what a network reaches there that was trained on development logs."""
    logs = {key: signals_of(path) for key, path in stores.items()}
    found: dict[str, dict[str, LabelScore]] = {}
    for condition in load_profile("warehouse_amr").conditions:
        span = BACK[condition.timing], AHEAD[condition.timing]
        seen = [one for key, several in logs.items() if key[0] == "development" for one in several]
        x = np.concatenate([features(one, *span)[one["known"]] for one in seen])
        y = np.concatenate([has(one, condition.name)[one["known"]] for one in seen])
        predict = fitted(x, y)
        for (of_part, floors), several in logs.items():
            if of_part == part:
                scores = [scored(one, condition.name, predict(features(one, *span)))
                          for one in several]  # fmt: skip
                found.setdefault(floors, {})[condition.name] = pooled(scores)[0]
    return found


def signals_of(path: Path) -> list[dict[str, Any]]:
    """Of each recording every step's signals, ends of episodes included, in order."""
    writer = StoreWriter(path)
    logs = []
    for row in writer.live().to_pylist():
        rows = writer.rows(row["recording_id"], row["ingest_id"])
        ends = episode_ends(rows)
        if ends is None:
            continue
        episode, step, truth = (
            [*rows["episode_index"].to_pylist(), *ends["episode_index"].to_pylist()],
            [*rows["step_index"].to_pylist(), *ends["step_index"].to_pylist()],
            [*rows["true_condition"].to_pylist(), *[None] * len(ends)],
        )
        order = np.lexsort((step, episode))
        one: dict[str, Any] = {
            name: np.concatenate([rows[name].to_numpy(), ends[name].to_numpy()])[order].astype(
                float
            )
            for name in ends.column_names
        }
        one["truth"] = [truth[place] for place in order]
        one["known"] = np.array([text is not None for text in one["truth"]])
        logs.append(one)
    return logs


def has(one: Mapping[str, Any], name: str) -> Bools:
    return np.array([text is not None and name in true_names(text) for text in one["truth"]])


def features(one: Mapping[str, Any], back: int, ahead: int) -> F32:
    """The signals of the steps around each, (N, F): no other episode's."""
    moved = one["wheel_speed_mps"], one["localised_speed_mps"]
    bearing = one["pose_yaw_rad"] + np.arctan2(one["waypoint_near_y_m"], one["waypoint_near_x_m"])
    reach = np.minimum(one["clearance_ahead_m"], 4) + 0.35
    place = (one["pose_x_m"] + reach * np.cos(bearing), one["pose_y_m"] + reach * np.sin(bearing))
    turned = one["wheel_yaw_rate_radps"] - one["gyro_yaw_rate_radps"]
    plain = [*moved, one["localised_lateral_mps"], turned, one["gyro_yaw_rate_radps"],
             one["accel_x_mps2"] / 3, 4 * np.minimum(one["clearance_m"], 0.4),
             np.minimum(one["clearance_m"], 1.5), np.minimum(one["clearance_ahead_m"], 3),
             one["waypoint_near_x_m"], one["waypoint_near_y_m"], one["waypoint_far_x_m"],
             one["waypoint_far_y_m"], one["bumped"], one["command_speed_mps"],
             one["command_yaw_rate_radps"], np.minimum(one["route_remaining_m"], 3)]  # fmt: skip
    columns = []
    for k in range(-back, ahead + 1):
        columns += [np.nan_to_num(at(one, column, k)) for column in plain]
        columns += [np.clip(np.nan_to_num(at(one, column, k) - column), -2, 2) for column in place]
        way = (at(one, moved[0], k) + at(one, moved[0], k + 1)) / 2 - at(one, moved[1], k + 1)
        columns += [np.abs(np.nan_to_num(way)), np.abs(np.nan_to_num(at(one, turned, k)))]
    # What every rule compares a distance with is near .15 m: finer there.
    near = [np.nan_to_num(at(one, one["clearance_m"], k), nan=4.0) for k in range(-3, ahead + 1)]
    columns += [np.clip(20 * (column - 0.15), -2, 2) for column in near]
    return np.stack(columns, axis=1).astype(np.float32)


def at(one: Mapping[str, Any], column: Any, k: int) -> Any:
    """The column k steps later, NaN beyond the episode, (N,)."""
    episode = one["episode_index"]
    there = np.arange(len(column)) + k
    inside = (there >= 0) & (there < len(column))
    there = np.clip(there, 0, len(column) - 1)
    return np.where(inside & (episode[there] == episode), column[there], np.nan)


def fitted(x: F32, y: Bools) -> Any:
    """A network's probabilities, as a function of features."""
    torch.manual_seed(0)
    middle, scale = x.mean(0), x.std(0) + 1e-3
    inputs, wanted = torch.from_numpy((x - middle) / scale), torch.from_numpy(y.astype(np.float32))
    net = torch.nn.Sequential(
        torch.nn.Linear(x.shape[1], WIDTH), torch.nn.LayerNorm(WIDTH), torch.nn.ReLU(),
        torch.nn.Dropout(0.3), torch.nn.Linear(WIDTH, WIDTH), torch.nn.ReLU(),
        torch.nn.Dropout(0.3), torch.nn.Linear(WIDTH, 1),
    )  # fmt: skip
    optimizer = torch.optim.AdamW(net.parameters(), 1e-3, weight_decay=1e-2)
    steps = EPOCHS * (len(x) // BATCH + 1)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 3e-3, total_steps=steps)
    for _ in range(EPOCHS):
        for batch in torch.randperm(len(x)).split(BATCH):
            loss = torch.nn.functional.binary_cross_entropy_with_logits(
                net(inputs[batch])[:, 0], wanted[batch]
            )
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    net.eval()

    def predict(features: F32) -> F32:
        with torch.no_grad():
            scaled = torch.from_numpy((features - middle) / scale)
            return np.asarray(torch.sigmoid(net(scaled)[:, 0]).numpy())

    return predict


def scored(one: Mapping[str, Any], name: str, probability: F32) -> LabelScore:
    """The label that holds where a step near it is clear, as the shipped rules do."""
    clear = np.max([np.nan_to_num(at(one, probability, k)) for k in range(-NEAR_STEPS, 1)], axis=0)
    known = one["known"]
    holds = ((probability > HOLDS) & (clear > CLEAR))[known]
    truth = [text for text in one["truth"] if text is not None]
    episode, step = (one[key][known].astype(np.int64) for key in ("episode_index", "step_index"))
    found = score({name: holds}, truth, episode, step, 0.2)
    return found[0] if found else LabelScore(name, len(truth), *[0] * 7)


if __name__ == "__main__":
    sys.exit(main())
