"""Check rows against the rows around them, the task's rewards, the twin's values and the store.

A store keeps the signals that labels and terminations were computed from, so both can be computed
again. A panel's labels are compared with those of the store that it was made from.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pyarrow as pa

from restock.arrays import F32, F64, Bools
from restock.errors import ConfigError
from restock.ingest.profile.profile import Profile
from restock.ingest.store.transitions import label_table
from restock.ingest.task.conditions import Condition, label
from restock.ingest.task.task import STORED_SIGNALS, Signals, reward_parts, terminated
from restock.replay.store.parquet_views import passed_in
from restock.replay.store.store import Store
from restock.stats import (
    ConfidenceInterval,
    cluster_counts,
    clustered_quantiles,
    percentiles,
)
from restock.train.judge.answers import MIN_CLUSTERS, RESAMPLES, ratio_of
from restock.train.judge.fed_rows import (
    MAX_ROWS,
    Comparison,
    FedRows,
    Flags,
    judged,
    not_run,
    share_judged,
    shares_compared,
    unflagged,
)
from restock.train.twin.calibration.logged_steps import LoggedSteps, logged_steps, rows_of

MOST = 0.005  # largest share of rows that may be off; by definition, none should be
_EQUAL = 1e-4


def row_order(rows: FedRows) -> Iterator[Comparison]:
    """Check rows against the rows before and after them."""
    joined, before = rows.joined, np.maximum(np.arange(len(rows)) - 1, 0)
    held, previous = rows.previous_action(), rows.action[before]
    apart = _differ(rows.next_observation[before], rows.observation)
    change = rows.sectors() - rows.sectors()[before]
    names = enumerate(rows.task.observation_names)
    first = next((place for place, name in names if name.startswith("closing_")), 0)
    closing = rows.observation[:, first : first + rows.task.sectors]
    moving = np.abs(rows.now("wheel_speed")) > 0.1
    same = ~_differ(rows.observation, rows.next_observation)
    after = rows.sectors(after=True) - rows.sectors()
    nearer = rows.next_observation[:, first : first + rows.task.sectors]
    own = rows.previous_action(after=True) != rows.action
    strange = own | (np.abs(after - nearer) > 10 * _EQUAL).any(axis=1)
    own_again = same[strange & rows.last].sum() > 0.8 * (strange & rows.last).sum()
    of_end = "it repeats the row's own observation" if own_again else "it is wrong or missing"
    late = np.diff(rows.logged_ns, prepend=0) > 1.5e9 * rows.task.control_period_s
    together = np.bincount(rows.episode, apart & late & joined) > 0
    begins = np.append(True, rows.last[:-1])[: len(rows)]
    begun = set(zip(rows.recording[begins], map(bytes, rows.observation[begins]), strict=True))
    goes_on = zip(rows.recording, rows.next_observation, rows.last, strict=True)
    cut = np.array([last and (name, bytes(after)) in begun for name, after, last in goes_on], bool)
    for check, what, off, of in (
        ("chain", "next observation is not the observation of the next row", apart, joined),
        ("previous action", "observation does not contain the action of the row before",
         held != previous, joined),
        ("own action", "next observation does not contain the row's own action",
         own, np.ones(len(rows), np.bool_)),
        ("foresight", "observation contains the action that is only taken afterwards",
         held == rows.action, joined & (rows.action != previous)),
        ("closing", "clearances did not change as in the observation",
         (np.abs(change - closing) > 10 * _EQUAL).any(axis=1), joined),
        ("unchanged", "next observation equals the observation, though the robot moves", same,
         moving & ~rows.last),
        ("last next", "last next observation of an episode does not follow from its row", strange,
         rows.last),
        ("split episodes", "episode without an end stops where another begins", cut,
         rows.last & ~rows.terminated & ~rows.truncated),
        ("joined episodes", "episode skips time, and continues elsewhere",
         together[rows.episode], rows.last),
    ):  # fmt: skip
        note = of_end if check == "last next" else ""
        yield share_judged(check, what, int((off & of).sum()), int(of.sum()), MOST, note=note)
    yield _check_repeated(rows, moving & ~same)


def _check_repeated(rows: FedRows, moving: Bools) -> Comparison:
    """Count moving rows that equal another one byte for byte; noise is never the same twice."""
    both = np.concatenate([rows.observation, rows.next_observation], axis=1)[moving]
    again = len(both) - len(set(map(bytes, both)))
    return share_judged(
        "repeated rows", "row in which the robot moves is stored twice", again, len(both), MOST
    )


def _differ(first: F32, second: F32) -> Bools:
    return np.asarray((np.abs(first - second) > _EQUAL).any(axis=1), np.bool_)


SCALE = 1.05  # largest ratio of rewards to the task's own, either way
OTHER = 0.05  # largest share of rows with another reward than the task's own
LOST = 0.05  # largest share of ends of episodes that may be wrong
UNCAUSED = "terminated without cause"
_JUMP_M = 0.9  # larger changes in one step mean that the plan was replaced
_TOUCHING_M = 0.05
_MIN_REWARD = 0.05  # rewards and errors below this may be noise of float32 and clearances
_ARRIVED_M = 0.15  # added to the goal's radius, as plans are no shorter than the distance


def implied_reward(rows: FedRows) -> F64:
    """Return the reward (N,) that the observations imply; NaN if they do not imply one."""
    task = rows.task
    clearance = np.full(len(rows), np.nan)
    if task.lidar:
        clearance = rows.sectors(after=True).min(axis=1) ** 2 * task.range_max_m
    unknown: Signals = {signal.name: np.zeros(len(rows), signal.dtype) for signal in STORED_SIGNALS}
    now: Signals = unknown | {"wheel_speed_mps": rows.now("wheel_speed")}
    after: Signals = unknown | {
        "wheel_speed_mps": rows.after("wheel_speed"),
        "localised_speed_mps": rows.after("localised_speed"),
        "clearance_m": clearance,
        "goal_distance_m": np.full(len(rows), np.inf),
    }
    progress = _progress(rows)
    parts = reward_parts(task, now, after, progress, rows.action, rows.previous_action())
    implied = np.asarray(sum(parts.values()), np.float64)
    implied[(clearance < _TOUCHING_M) | arrived(rows) | rows.terminated] = np.nan
    if rows.task.reward_terms:  # custom terms use signals that observations do not contain
        implied[:] = np.nan
    return implied


def arrived(rows: FedRows) -> Bools:
    """Return whether the robot is at its goal after each row (N,), judged by its plan."""
    if rows.task.goal == "none":
        return np.zeros(len(rows), np.bool_)
    to_go = 10.0 * rows.after("goal_distance")
    return np.asarray(to_go <= rows.task.goal_radius_m + _ARRIVED_M, np.bool_)


def _progress(rows: FedRows) -> F64:
    if rows.task.goal == "none":
        return rows.after("localised_speed") * rows.task.control_period_s
    now, after = rows.now("goal_distance"), rows.after("goal_distance")
    shorter = 10.0 * (now - after)
    shorter[(now >= 1.0) | (after >= 1.0) | (np.abs(shorter) > _JUMP_M)] = np.nan
    return np.asarray(shorter)


def outcomes(logs: FedRows, twin: FedRows | None) -> Iterator[Comparison]:
    """Check rewards, then terminations."""
    yield from _check_rewards(logs, twin)
    yield from _check_terminations(logs, twin)


def _check_rewards(logs: FedRows, twin: FedRows | None) -> Iterator[Comparison]:
    what = "reward against the task's own reward for the same observations"
    implied = implied_reward(logs)
    telling = np.abs(implied) > _MIN_REWARD  # False for NaN
    if len(np.unique(logs.cluster[telling])) < MIN_CLUSTERS:
        yield not_run(
            "reward scale", what, "too few rows whose reward follows from their observations"
        )
        return
    ratio = logs.reward[telling] / implied[telling]
    (scale,) = clustered_quantiles(
        ratio, logs.cluster[telling], (0.5,), rng=np.random.default_rng([0, 2]), resamples=RESAMPLES
    )
    yield judged(
        "reward scale", what, "ratio", scale, logs=float(np.median(ratio)), twin=1.0,
        least=1 / SCALE, most=SCALE, logs_rows=int(telling.sum()),
    )  # fmt: skip
    what = "row's reward is not the task's own, whatever its scale"
    found = _count_unlike(logs, implied, scale.value)
    if twin is None:
        yield share_judged("reward rows", what, *found, OTHER)
    else:
        expected = _count_unlike(twin, implied_reward(twin), 1.0)
        yield shares_compared("reward rows", what, found, expected, -1.0, OTHER)


def _count_unlike(rows: FedRows, implied: F64, scale: float) -> tuple[int, int]:
    """Count rows whose reward is not `implied` times `scale`, and rows with an implied reward."""
    known = np.isfinite(implied)
    scale = scale if abs(scale) > _MIN_REWARD else 1.0
    off = np.abs(rows.reward[known] / scale - implied[known]) > _MIN_REWARD
    return int(off.sum()), int(known.sum())


def _check_terminations(logs: FedRows, twin: FedRows | None) -> Iterator[Comparison]:
    weight, ends = logs.task.rewards, logs.terminated
    cause = arrived(logs) | (logs.reward > weight.goal / 2) | (logs.reward < weight.bump / 2)
    for check, what, off, of in (
        ("goes on after its end", "row is terminated and its episode goes on", ~logs.last, ends),
        (UNCAUSED, "terminated row neither at its goal nor in a bump, by plan and reward",
         ~cause, ends & logs.last),
    ):  # fmt: skip
        yield share_judged(check, what, int((off & of).sum()), int(of.sum()), LOST)
    if logs.task.goal == "none":
        for check in ("terminated at the goal", "goal reward"):
            yield not_run(check, "what happens on arrival", "the task has no goal")
        return

    def at_goal(rows: FedRows) -> tuple[int, int]:
        there = arrived(rows) & rows.last
        return int((rows.terminated & there).sum()), int(there.sum())

    what = "episode that ends at its goal is terminated there"
    if twin is not None:
        yield shares_compared(
            "terminated at the goal", what, at_goal(logs), at_goal(twin), -LOST, LOST
        )
    else:
        yield share_judged("terminated at the goal", what, *at_goal(logs), 1.0, least=1 - LOST)
    yield _goal_reward(logs, twin)


def _goal_reward(logs: FedRows, twin: FedRows | None) -> Comparison:
    what = "reward of the last step of episodes that end at their goal"
    there = arrived(logs) & logs.last
    if there.sum() < 5:
        return not_run("goal reward", what, "fewer than 5 episodes end there")
    value = float(np.median(logs.reward[there]))
    expected = logs.task.rewards.goal
    if twin is not None and (arrived(twin) & twin.last).sum() >= 5:
        expected = float(np.median(twin.reward[arrived(twin) & twin.last]))
    if not expected:
        return not_run("goal reward", what, "arriving earns nothing")
    ends = np.quantile(logs.reward[there], [0.25, 0.75]) / expected
    interval = ConfidenceInterval(value / expected, float(ends.min()), float(ends.max()))
    return judged("goal reward", what, "ratio", interval, logs=value, twin=expected,
                  least=1 / SCALE, most=SCALE, logs_rows=int(there.sum()))  # fmt: skip


BEYOND = 0.02  # largest share of rows that may be far beyond the twin's range
SPREAD = 10.0  # largest ratio of a value's spread to the twin's, either way
TURNED_DEG = 20.0
LIDAR_SCALE = 1.5  # largest ratio of the lidar's scale to the twin's, either way
MEASURED = (
    *("wheel_speed", "localised_speed", "lateral_speed", "gyro_yaw_rate", "accel_x"),
    "goal_distance",
)
CLEARANCES = "clearances"  # name of the lidar's mean over all sectors
_MAY_BE_STILL = ("lateral_speed",)  # always 0 if a robot does not slide
_WIDER = 1.0  # values may exceed the twin's range by this share of it on each side
_STRAIGHT_RADPS = 0.15
_DRIVING_MPS = 0.25
_FAR = 0.97  # lidar entries beyond this saw nothing


def values(logs: FedRows, twin: FedRows | None) -> Iterator[Comparison]:
    """Check ranges and spreads of measured values, then the lidar's bearing and scale."""
    if twin is None:
        yield not_run("range", "values against the twin's", "no twin to compare with")
    else:
        few = len(np.unique(logs.episode)) < MIN_CLUSTERS
        for name in (*MEASURED, CLEARANCES) if logs.task.lidar else MEASURED:
            for row in _check_entry(name, logs, twin, np.random.default_rng([0, 4])):
                yield replace(row, status="undecided") if few and row.off else row
    yield from _lidar(logs, twin, np.random.default_rng([0, 3]))


def _check_entry(
    name: str, logs: FedRows, twin: FedRows, rng: np.random.Generator
) -> Iterator[Comparison]:
    of_logs, of_twin = (
        rows.sectors().mean(axis=1) if name == CLEARANCES else rows.now(name)
        for rows in (logs, twin)
    )
    low, high = float(of_twin.min()), float(of_twin.max())
    room = _WIDER * (high - low)
    if room <= 0:
        return
    beyond = (of_logs < low - room) | (of_logs > high + room)
    yield share_judged(
        f"range: {name}", f"{name} is far beyond any of the twin's", int(beyond.sum()), len(logs),
        BEYOND, note=f"{float(of_logs.min()):.3g} to {float(of_logs.max()):.3g}, in the twin"
        f" {low:.3g} to {high:.3g}",
    )  # fmt: skip
    least, most = clustered_quantiles(
        of_logs, logs.cluster, (0.05, 0.95), rng=rng, resamples=RESAMPLES
    )
    expected = float(np.subtract(*np.quantile(of_twin, [0.95, 0.05])))
    spread = ConfidenceInterval(
        (most.value - least.value) / expected,
        (most.low - least.high) / expected,
        (most.high - least.low) / expected,
    )
    yield judged(
        f"spread: {name}", f"spread of {name} against the twin's", "ratio", spread,
        logs=most.value - least.value, twin=expected,
        least=0.0 if name in _MAY_BE_STILL else 1 / SPREAD, most=SPREAD,
        logs_rows=len(logs), twin_rows=len(twin),
    )  # fmt: skip


def _lidar(logs: FedRows, twin: FedRows | None, rng: np.random.Generator) -> Iterator[Comparison]:
    """Check the lidar's bearing, and its scale against the twin's.

    The approach is how much nearer things come per metre, by sector. The bearing is the rotation in
    degrees between the logs' and the twin's approach (or a cosine), and the scale is their ratio.
    """
    what = "bearing in which things come nearer when driving straight on"
    if not logs.task.lidar:
        yield not_run("lidar bearing", what, "the robot has no lidar")
        return
    task, width = logs.task, 360 / logs.task.sectors
    found = _measure_approach(logs, rng)
    expected = _measure_approach(twin, rng) if twin is not None else None
    if expected is not None:
        shape = expected[0]
    else:
        shape = np.cos(np.radians((np.arange(task.sectors) + 0.5) * width - 180))
    if found is None or (twin is not None and expected is None):
        yield not_run("lidar bearing", what, "too few rows of driving straight on")
        return
    turns = np.arange(task.sectors)
    turned = np.stack([np.roll(shape, turn) for turn in turns])  # (turns, sectors)
    fits = found @ turned.T  # (1 + R, turns): similarity at each turn
    best = fits.argmax(axis=1)
    degrees = np.where(best > task.sectors // 2, best - task.sectors, best) * width
    low, high = percentiles(degrees[1:])
    rows, twin_rows = len(logs), len(twin) if twin is not None else 0
    yield judged(
        "lidar bearing", what, "degrees", ConfidenceInterval(float(degrees[0]), low, high),
        logs=float(degrees[0]), twin=0.0, least=-TURNED_DEG, most=TURNED_DEG,
        logs_rows=rows, twin_rows=twin_rows,
    )  # fmt: skip
    if expected is not None and twin is not None:
        nearer, of_twin = fits.max(axis=1), expected @ shape
        fewer = min(len(np.unique(one.cluster)) for one in (logs, twin))
        at = float(nearer[0]), float(of_twin[0])
        norm = float(shape @ shape)
        yield judged(
            "lidar scale", "how much nearer things come for a metre driven", "ratio",
            ratio_of(nearer[1:], of_twin[1:], at, fewer), logs=at[0] / norm, twin=at[1] / norm,
            least=1 / LIDAR_SCALE, most=LIDAR_SCALE,
            logs_rows=rows, twin_rows=twin_rows,
        )  # fmt: skip


def _measure_approach(rows: FedRows, rng: np.random.Generator) -> F64 | None:
    """Return how much nearer things come per metre driven, (1 + R, sectors); None if too few rows.

    Values are relative to the mean over sectors. The first row is of all clusters, the others are
    bootstrap draws.
    """
    task = rows.task
    now, after = rows.sectors() ** 2 * task.range_max_m, rows.sectors(after=True) ** 2
    after = after * task.range_max_m
    driven = rows.after("localised_speed") * task.control_period_s
    straight = np.abs(rows.after("gyro_yaw_rate")) < _STRAIGHT_RADPS
    straight &= np.abs(driven) > _DRIVING_MPS * task.control_period_s
    most = _FAR**2 * task.range_max_m
    seen: Bools = straight[:, None] & (now < most) & (after < most) & (np.abs(after - now) < 0.5)
    place = np.unique(rows.cluster, return_inverse=True)[1].reshape(-1)
    clusters = int(place.max(initial=-1)) + 1
    if clusters < MIN_CLUSTERS or seen.sum() < 100:
        return None
    above, below = np.zeros((2, clusters, task.sectors))
    np.add.at(above, place, np.where(seen, (now - after) * driven[:, None], 0.0))
    np.add.at(below, place, np.where(seen, driven[:, None] ** 2, 0.0))
    counts = np.concatenate([np.ones((1, clusters)), cluster_counts(clusters, RESAMPLES, rng)])
    bottom = counts @ below
    slope = np.where(bottom > 1e-9, (counts @ above) / np.maximum(bottom, 1e-9), 0.0)
    return np.asarray(slope - slope.mean(axis=1, keepdims=True))


FAR = 0.25  # a command is far from its action beyond this distance; 1 is the fastest action
COARSE = 0.1  # actions are too coarse if a larger share of commands is far from them
DIFFERENT = 0.02  # largest share of wrong labels among rows that have, or should have, the label
_LABELS = "row's label differs from what its conditions give on the stored signals"
_FED = "row's label in the panel differs from that in its store"
_ENDS = "termination of the row does not agree with its signals"


def stored(
    store: Store, rows: FedRows, profile: Profile, conditions: Sequence[Condition]
) -> Iterator[Flags]:
    """Check commands, labels and terminations against the store that has the `rows`.

    Labels and terminations are checked in whole recordings, about `MAX_ROWS` rows in total.
    `conditions` are those of the profile that can be computed from the stored signals.
    """
    yield _check_commands(store, rows)
    recordings, left_out = _choose_recordings(store, rows.task.hash, profile.labels_version)
    if not recordings:
        for check, what in (("labels", _LABELS), ("terminations", _ENDS)):
            yield unflagged(check, what, left_out)
        return
    steps = logged_steps(store, rows.task.hash, recordings)
    whole = _in_whole_episodes(steps)
    yield from _check_labels(steps, whole, profile.shown_by_logs(conditions), left_out)
    yield _check_stored_terminations(steps, rows)


def fed_labels(store: Store, rows: FedRows) -> Iterator[Flags]:
    """Compare the panel's labels with those of its store, per condition."""
    fed = pa.table({"transition_id": rows.transition_id, "fed": rows.condition})
    with passed_in(store.connection, fed=fed):
        found = store.connection.sql(
            "SELECT transition_id, fed, coalesce(primary_condition, '') AS stored"
            " FROM fed JOIN transitions USING (transition_id) WHERE task_hash = ?",
            params=[rows.task.hash],
        ).fetchnumpy()
    names, kept = (np.asarray(found[name]).astype(np.str_) for name in ("fed", "stored"))
    for name in sorted({*names, *kept}):
        either = (names == name) | (kept == name)
        yield Flags(
            f"fed labels: {name}", _FED, found["transition_id"][either],
            (names != kept)[either], DIFFERENT,
        )  # fmt: skip


def _check_commands(store: Store, rows: FedRows) -> Flags:
    fed = pa.table({"transition_id": rows.transition_id})
    with passed_in(store.connection, fed=fed):
        found = store.connection.sql(
            "SELECT transition_id, action_residual FROM fed JOIN transitions USING (transition_id)"
            " WHERE task_hash = ? AND action_residual IS NOT NULL",
            params=[rows.task.hash],
        ).fetchnumpy()
    what = "command is far from the action that represents it"
    off = np.asarray(found["action_residual"] > FAR, np.bool_)
    return Flags("far commands", what, found["transition_id"], off, COARSE)


def _choose_recordings(store: Store, task_hash: str, version: str) -> tuple[list[str], str]:
    """Return recordings with labels of this version, and a note if there are others."""
    found = store.connection.sql(
        "SELECT recording_id, labels_version, count(*) FROM transitions WHERE task_hash = ?"
        " GROUP BY ALL ORDER BY ALL",
        params=[task_hash],
    ).fetchall()
    same = [(name, count) for name, labels, count in found if labels == version]
    total = np.cumsum([count for _, count in same])
    chosen = [name for (name, _), sum_ in zip(same, total, strict=True) if sum_ <= MAX_ROWS]
    chosen = chosen or [name for name, _ in same[:1]]
    others = len(found) - len(same)
    note = (
        f"{others} of {len(found)} recordings were labelled with other rules than the profile's, "
        "or corrected by people: `restock store label STORE` updates them"
        if others
        else ""
    )
    return chosen, note


def _in_whole_episodes(steps: LoggedSteps) -> Bools:
    """Return whether each row (N,) is of an episode that is stored completely, with its end."""
    ended = np.isin(steps.episode_id, steps.episode_id[steps.ending])
    broken = steps.episode_id[steps.begins & (steps.step_index > 0)]
    return np.asarray(ended & ~np.isin(steps.episode_id, broken), np.bool_)


def _check_labels(
    steps: LoggedSteps, whole: Bools, conditions: Sequence[Condition], note: str
) -> Iterator[Flags]:
    if not whole.any():
        yield unflagged("labels", _LABELS, "no episode is stored completely")
        return
    kept = np.flatnonzero(whole)
    ends = np.flatnonzero(whole[steps.ending])
    rows = np.concatenate([kept, steps.ending[ends]])
    step = np.concatenate([steps.step_index[kept], steps.step_index[steps.ending[ends]] + 1])
    episode = np.unique(steps.episode_id[rows], return_inverse=True)[1].reshape(-1)
    order = np.lexsort((step, episode))
    of_ends = rows_of(steps.ends, ends)
    signals = {
        name: np.concatenate([column[kept], of_ends[name]])[order]
        for name, column in steps.now.items()
    }
    custom = pa.table({"_": pa.nulls(len(order))}).select([])
    table = label_table(signals, episode[order].astype(np.int64), step[order], custom)
    try:
        again = label(table, list(conditions))
    except ConfigError as error:
        yield unflagged("labels", _LABELS, str(error))
        return
    is_row = order < len(kept)
    back = np.argsort(order[is_row])
    for name, holds in again.items():
        now = holds[is_row][back]
        before = steps.conditions.get(name, np.zeros(len(steps), np.bool_))[kept]
        either = now | before
        yield Flags(
            f"labels: {name}", _LABELS, steps.transition_id[kept][either],
            (now != before)[either], DIFFERENT, note,
        )  # fmt: skip


def _check_stored_terminations(steps: LoggedSteps, rows: FedRows) -> Flags:
    place = {number: index for index, number in enumerate(rows.transition_id.tolist())}
    at = np.array([place.get(number, -1) for number in steps.transition_id.tolist()], np.int64)
    known = steps.followed & (at >= 0)
    again = terminated(steps.task, rows_of(steps.after, np.flatnonzero(known)))
    stored_ends = rows.terminated[at[known]]
    either = again | stored_ends
    off = (again != stored_ends)[either]
    return Flags("terminations", _ENDS, steps.transition_id[known][either], off, DIFFERENT)
