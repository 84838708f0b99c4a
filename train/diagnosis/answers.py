"""Do the logs' sensors and actions answer to each other as the twin's do?

Of each relation the gain, the delay and what is left unexplained, in logs against in the twin; or
against what holds by definition where no twin can be driven. And of each action the motion that it
comes to when held: which of the twin's actions is that?
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from restock.arrays import F64
from restock.stats import ConfidenceInterval
from restock.train.diagnosis.evidence import Comparison, judged, not_run
from restock.train.diagnosis.fed_rows import FedRows
from restock.train.diagnosis.relations import RELATIONS, Relation, SlipLeftOut
from restock.train.diagnosis.response import Response, difference_of, interval_of, ratio_of

GAIN = 1.2  # of logs over the twin's, or its inverse
NOISY_GAIN = 2.0  # of relations that are no measurement of the same thing
DELAY_STEPS = 0.6
LATEST_STEPS = 2.0  # without a twin: how late a robot may answer to its commands
UNEXPLAINED = 0.2
NOISY_UNEXPLAINED = 0.4  # where it depends on who drives, and where
_KNOWN_GAIN = 0.3  # of logs over the twin's, for a delay to mean something
HELD = 3  # steps of one action in a row, for its motion to be that action's
_MIN_HELD = 15
_AWAY = 0.25  # of the fastest action on each axis
_MAX_ROWS = 0.8  # of an action's, those with the motion of one other
TwinFits = dict[tuple[str, SlipLeftOut], Response | None]  # by relation and what it leaves out


@dataclass(frozen=True)
class Answer:
    """A relation in logs and twin."""

    relation: Relation
    comparisons: tuple[Comparison, ...]
    gain: float  # logs over twin; NaN: not known
    delay: float  # logs less twin, steps

    @property
    def off(self) -> bool:
        return any(one.off for one in self.comparisons)

    @property
    def fine(self) -> bool:
        """Neither off nor undecided."""
        return all(one.status in ("ok", "not run") for one in self.comparisons)

    def is_off(self, figure: str) -> bool:
        """Whether its `gain`, `delay` or `unexplained` is."""
        return any(one.off and one.check.startswith(figure) for one in self.comparisons)


def answers(
    logs: FedRows, twin: FedRows | None, seed: int = 0, of_twin: TwinFits | None = None
) -> list[Answer]:
    """Every relation, compared. `of_twin` keeps the twin's fits for the next logs."""
    rng = np.random.default_rng([seed, 1])
    of_twin = {} if of_twin is None else of_twin
    return [_answer(relation, logs, twin, rng, of_twin) for relation in RELATIONS]


def _answer(
    relation: Relation,
    logs: FedRows,
    twin: FedRows | None,
    rng: np.random.Generator,
    of_twin: TwinFits,
) -> Answer:
    leave_out = relation.slip_to_leave_out(logs)
    found = relation.fit(logs, rng, leave_out)
    kept = relation.name, leave_out
    if twin is not None and kept not in of_twin:
        of_twin[kept] = relation.fit(twin, rng, leave_out)
    expected = of_twin.get(kept)
    name, what = relation.name, f"answer of the {relation.name}"
    if found is None or (twin is not None and expected is None):
        reason = "too few rows, or nothing moves, in the " + ("logs" if found is None else "twin")
        return Answer(relation, (not_run(f"gain: {name}", what, reason),), float("nan"), 0.0)
    if expected is None:
        return _by_definition(relation, found, what)
    most, most_left = (
        (GAIN, UNEXPLAINED) if relation.gain is not None else (NOISY_GAIN, NOISY_UNEXPLAINED)
    )
    fewer = min(found.clusters, expected.clusters)
    gain = ratio_of(found.gains, expected.gains, (found.gain, expected.gain), fewer)
    delay = difference_of(found.delays, expected.delays, (found.delay, expected.delay), fewer)
    left = difference_of(
        found.unexplained_draws,
        expected.unexplained_draws,
        (found.unexplained, expected.unexplained),
        fewer,
    )
    timed = len(relation.lags) > 1 and abs(gain.value) > _KNOWN_GAIN
    compared = [
        ("gain", "ratio", gain, found.gain, expected.gain, 1 / most, most),
        *[("delay", "steps later", delay, found.delay, expected.delay, -DELAY_STEPS, DELAY_STEPS)]
        * timed,
        ("unexplained", "difference", left, found.unexplained, expected.unexplained, -1.0,
         most_left),
    ]  # fmt: skip
    made = [
        judged(
            f"{figure}: {name}", what, measure, interval, logs=of_logs, twin=of_twin,
            least=low, most=high, logs_rows=found.rows, twin_rows=expected.rows,
        )
        for figure, measure, interval, of_logs, of_twin, low, high in compared
    ]  # fmt: skip
    return Answer(relation, tuple(made), gain.value, delay.value if timed else 0.0)


def _by_definition(relation: Relation, found: Response, what: str) -> Answer:
    """Without a twin: a speed is a speed, and commands come before what they cause."""
    name = relation.name
    if relation.gain is None:
        row = not_run(f"gain: {name}", what, "no twin to compare with")
        return Answer(relation, (row,), float("nan"), 0.0)
    of_unit = found.gain / relation.gain, found.gains / relation.gain
    gain = interval_of(*of_unit, found.clusters)
    delay = interval_of(found.delay, found.delays, found.clusters)
    made = [
        judged(f"gain: {name}", what, "ratio", gain, logs=found.gain, twin=None,
               least=1 / GAIN, most=GAIN, logs_rows=found.rows),
    ]  # fmt: skip
    if abs(gain.value) > _KNOWN_GAIN:
        made.append(
            judged(f"delay: {name}", what, "steps later", delay, logs=found.delay, twin=None,
                   least=-DELAY_STEPS, most=LATEST_STEPS, logs_rows=found.rows)
        )  # fmt: skip
    over = min(max(found.delay, 0.0), LATEST_STEPS)
    return Answer(relation, tuple(made), gain.value, found.delay - over)


def held_motion(rows: FedRows) -> list[F64]:
    """Of each action the motion (n, 2) of the rows that hold it: m/s and rad/s by the wheels."""
    held = np.ones(len(rows), np.bool_)
    for lag in range(1, HELD):
        place, known = rows.before(lag)
        held &= known & (rows.action[place] == rows.action)
    turn = rows.after("slip_yaw_rate") + rows.after("gyro_yaw_rate")
    motion = np.stack([rows.after("wheel_speed"), turn], axis=1)
    return [motion[held & (rows.action == action)] for action in range(len(rows.task.actions))]


def permuted_actions(logs: FedRows, twin: FedRows | None) -> Iterator[tuple[Comparison, int]]:
    """Of each action of the logs how far its motion is from that action's in the twin (or from the
    task's table), and the action (or itself) whose motion most of its rows have."""
    expected = np.array(logs.task.actions, np.float64)
    scale = np.maximum(np.abs(expected).max(axis=0), 1e-9)
    for action, motion in enumerate(held_motion(twin) if twin is not None else []):
        if len(motion) >= _MIN_HELD:
            expected[action] = np.median(motion, axis=0)
    names = logs.task.action_names
    for action, motion in enumerate(held_motion(logs)):
        name = names[action]
        what = f"motion under the action {name!r}, held"
        if len(motion) < _MIN_HELD:
            yield not_run(f"action: {name}", what, "hardly held in the logs"), action
            continue
        away = np.linalg.norm((motion[:, None] - expected) / scale, axis=2)  # (n, A)
        middle = np.median(away, axis=0)
        nearest = int(np.bincount(away.argmin(axis=1)).argmax())
        share = float((away.argmin(axis=1) == nearest).mean())
        is_other = nearest != action and middle[action] > _AWAY and share >= _MAX_ROWS
        speed, turn = np.median(motion, axis=0)
        distance = float(middle[action])
        row = judged(
            f"action: {name}", what, "distance", ConfidenceInterval(distance, distance, distance),
            logs=distance, twin=float(middle[nearest]),
            most=_AWAY if is_other else math.inf, logs_rows=len(motion),
            note=f"{speed:+.2f} m/s, {turn:+.2f} rad/s: {share:.0%} nearest to {names[nearest]!r}",
        )  # fmt: skip
        # A median decided by a share: there is no interval to show.
        yield replace(row, low=None, high=None), nearest if is_other else action


__all__ = ["Answer", "TwinFits", "answers", "held_motion", "permuted_actions"]
