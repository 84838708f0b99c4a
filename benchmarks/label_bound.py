"""The best that any rule could do: a network that saw the truth of many logs and all the sensors.

`python benchmarks/labels.py --cache FOLDER --bound` prints it beside the rules. A network of two
layers is trained on development logs: all stored signals and the lidar's sectors, of the steps
around (`pre` conditions: 8 s before and none after). Its thresholds are chosen on the logs that it
is measured on, which no rule may do: a rule within .02 of it is at what the sensors tell.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch

from restock.arrays import F32, Bools
from restock.ingest.profile.profile import load_profile
from restock.ingest.store.manifest import LabelScore, events, touched, widened
from restock.ingest.store.transitions import episode_ends
from restock.ingest.store.writer import StoreWriter
from restock.ingest.task.conditions import Condition
from restock.ingest.task.schema import true_names
from restock.train.twin.calibration.logged_steps import sector_clearance

Log = dict[str, Any]  # every step's signals by name (N,), ends of episodes included
UNKNOWN = "?"  # truth
LAGS = {"pre": (-40, -30, -25, -20, -15, -12, -10, -8, -6), "post": (-8, -6)}  # steps
AROUND = {"pre": range(-5, 1), "post": range(-4, 4)}
SECTORS, SECTOR_LAGS = 9, (-10, -4, -1, 0)  # each side of the way; steps
EPOCHS, BATCH, WIDTH = 8, 512, 128
USUAL = 0.3  # share of the steps without the condition that it is trained on
CLEAR = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)  # a label holds near a step so probable,
HOLDS = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5)  # while it is as probable as this,
BACK = (0, 2, 5, 10)  # this many steps later
REACH = 2  # steps of .2 s between an event and what finds it


def bounds(
    development: Sequence[Log], measured: Mapping[str, Sequence[Log]]
) -> dict[str, dict[str, LabelScore]]:
    """Floors -> condition -> what a network reaches there that was trained on development logs."""
    found: dict[str, dict[str, LabelScore]] = {floors: {} for floors in measured}
    for condition in load_profile("warehouse_amr").conditions:
        print(f"bound of {condition.name}", file=sys.stderr)
        rng = np.random.default_rng(0)
        parts = []
        for one in development:
            true = has(one, condition.name)
            chosen = one["known"] & (true | (rng.random(len(true)) < USUAL))
            parts.append((features(one, condition.timing)[chosen], true[chosen]))
        predict = fitted(*(np.concatenate(part) for part in zip(*parts, strict=True)))
        for floors, logs in measured.items():
            probable = [predict(features(one, condition.timing)) for one in logs]
            found[floors][condition.name] = best(logs, condition, probable)
    return found


def logs_of(store: Path) -> Iterator[Log]:
    """Yield the signals of each recording's steps, in order."""
    task = load_profile("warehouse_amr").task
    writer = StoreWriter(store)
    for row in writer.live().to_pylist():
        rows = writer.rows(row["recording_id"], row["ingest_id"])
        ends = episode_ends(rows)
        if ends is None:
            continue
        last = np.searchsorted(rows["episode_index"].to_numpy(), ends["episode_index"].to_numpy(),
                               side="right") - 1  # fmt: skip
        seen = [np.stack(rows[name].to_numpy()) for name in ("observation", "next_observation")]
        one: Log = {
            name: np.concatenate([rows[name].to_numpy(), ends[name].to_numpy()]).astype(float)
            for name in ends.column_names
        }
        one["sector_clearance_m"] = sector_clearance(task, np.concatenate([seen[0], seen[1][last]]))
        truth = [text or UNKNOWN for text in rows["true_condition"].to_pylist()]
        one["truth"] = np.array([*truth, *[UNKNOWN] * len(ends)])
        order = np.lexsort((one["step_index"], one["episode_index"]))
        yield with_known({name: column[order] for name, column in one.items()})


def with_known(one: Log) -> Log:
    return one | {"known": one["truth"] != UNKNOWN}


def has(one: Log, name: str) -> Bools:
    """Return where a condition is true, (N,)."""
    texts, which = np.unique(one["truth"], return_inverse=True)
    return np.array([text != UNKNOWN and name in true_names(text) for text in texts])[which]


def features(one: Log, timing: str) -> F32:
    """Return what the network sees of each step, (N, F): no other episode's steps."""
    bearing = np.arctan2(one["waypoint_near_y_m"], one["waypoint_near_x_m"])
    way = np.minimum(one["plan_return_m"], 2.5)
    turned = one["wheel_yaw_rate_radps"] - one["gyro_yaw_rate_radps"]
    room, ahead = np.minimum(one["clearance_m"], 1.5), np.minimum(one["clearance_ahead_m"], 3)
    plain = [one["wheel_speed_mps"], one["localised_speed_mps"], one["localised_lateral_mps"],
             turned, one["gyro_yaw_rate_radps"], one["accel_x_mps2"] / 3, room, ahead, way,
             one["came_nearer_m"], one["waypoint_near_x_m"], one["waypoint_near_y_m"],
             one["waypoint_far_x_m"], one["waypoint_far_y_m"], one["bumped"],
             one["command_speed_mps"], one["command_yaw_rate_radps"],
             np.minimum(one["route_remaining_m"], 3)]  # fmt: skip
    place = way - one["route_remaining_m"]  # along the plan: of a pallet it stays
    wheels, localised = one["wheel_speed_mps"], one["localised_speed_mps"]
    columns = []
    for k in (*LAGS[timing], *AROUND[timing]):
        columns += [np.nan_to_num(at(one, column, k)) for column in plain]
        columns.append(np.clip(np.nan_to_num(at(one, place, k) - place), -2, 2))
        over = (at(one, wheels, k) + at(one, wheels, k - 1)) / 2 - at(one, localised, k)
        columns += [np.abs(np.nan_to_num(over)), np.abs(np.nan_to_num(at(one, turned, k)))]
    # Who came nearer within 8 s; and what every rule compares a distance with is near .15 m.
    came = np.maximum(one["came_nearer_m"] - 0.03, 0)
    recent = np.sum([np.nan_to_num(at(one, came, -k)) for k in range(4)], axis=0)
    columns += [np.max([np.nan_to_num(at(one, recent, -k)) for k in range(n)], axis=0)
                for n in (10, 25, 41)]  # fmt: skip
    for k in (-3, *AROUND[timing]):
        near = np.nan_to_num(at(one, one["clearance_m"], k), nan=4.0)
        columns += [np.clip(20 * (near - 0.15), -2, 2), np.clip(5 * (near - 0.15), -1, 1)]
    sectors = one["sector_clearance_m"]
    middle = np.floor((bearing + np.pi) * (sectors.shape[1] / (2 * np.pi))).astype(int)
    beside = (middle[:, None] + np.arange(-SECTORS, SECTORS + 1)) % sectors.shape[1]
    toward = np.sqrt(np.take_along_axis(np.minimum(sectors, 4), beside, axis=1))
    for k in SECTOR_LAGS:
        columns += [np.nan_to_num(at(one, column, k)) for column in toward.T]
    return np.stack(columns, axis=1).astype(np.float32)


def at(one: Log, column: Any, k: int) -> Any:
    """Return the column k steps later, NaN beyond the episode, (N,)."""
    episode = one["episode_index"]
    there = np.arange(len(column)) + k
    inside = (there >= 0) & (there < len(column))
    there = np.clip(there, 0, len(column) - 1)
    return np.where(inside & (episode[there] == episode), column[there], np.nan)


def fitted(x: F32, y: Bools) -> Any:
    """Return a network's probabilities, as a function of features."""
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


def best(logs: Sequence[Log], condition: Condition, probable: Sequence[F32]) -> LabelScore:
    """Return the score of these probabilities by the thresholds that suit events best."""
    ahead = 2 if condition.timing == "post" else 0
    known = np.concatenate([one["known"] for one in logs])
    true = np.concatenate([has(one, condition.name) for one in logs])[known]
    goes_on = np.concatenate([np.diff(one["episode_index"], prepend=-1) == 0 for one in logs])
    goes_on = goes_on[known] & np.concatenate([[False], known[:-1]])[known]
    probability = np.concatenate(probable)[known]
    events_true, near_true = events(true, goes_on), widened(true, goes_on, REACH)
    found: list[LabelScore] = []
    for back in BACK:
        clear = np.concatenate([
            np.max([np.nan_to_num(at(one, p, k)) for k in range(-back, ahead + 1)], axis=0)
            for one, p in zip(logs, probable, strict=True)
        ])[known]  # fmt: skip
        for certain, holds in product(CLEAR, HOLDS):
            if holds > certain:
                continue
            given = (probability > holds) & (clear > certain)
            counts = (len(true), given.sum(), true.sum(), (given & true).sum())
            labelled = events(given, goes_on)
            right = touched(labelled, near_true).sum()
            by = touched(events_true, widened(given, goes_on, REACH)).sum()
            counts += (len(labelled), right, len(events_true), by)
            found.append(LabelScore(condition.name, *map(int, counts)))
    return max(found, key=lambda s: (min(s.event_precision or 0, s.event_recall or 0),
                                     min(s.precision or 0, s.recall or 0)))  # fmt: skip
