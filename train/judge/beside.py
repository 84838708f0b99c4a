"""Compare robots of a fleet with each other: relations, stretches of drives, and values.

Robots of a fleet differ less from each other than from the twin. A fault that lasts for a part of
a drive shows in its stretches, and one that replaces values in how these repeat.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from restock.arrays import F64, Bools, Ints
from restock.stats import ConfidenceInterval
from restock.train.judge import answers as ends
from restock.train.judge.answers import Answer, Relation, lagged, wheel_turn
from restock.train.judge.fed_rows import Comparison, FedRows, judged, shares_compared
from restock.train.judge.row_checks import implied_reward

MIN_BESIDE = 4  # robots or recordings, for one to be the odd one out
_ALIKE = 0.75  # of the others, for what they agree on to be the measure
GAIN, ANSWER, NOISY = 1.02, 1.15, 1.25  # of two sensors of one motion, of commands, of the others
_MOST = {"delay": 0.4, "unexplained": 0.1}  # steps, and of the mean square


def beside_others(answers: Sequence[Answer]) -> list[Answer]:
    """Compare one relation in several robots: each with the middle of the others."""
    made = list(answers)
    relation = answers[0].relation
    if len(made) < MIN_BESIDE:
        return made
    gain = GAIN if relation.most == ends.ALIKE else NOISY if relation.gain is None else ANSWER
    figures = {"gain": math.log(gain)} | _MOST if relation.y != ends.PLAN else {}  # driven apart
    for figure, most in figures.items():
        rows = [next((row for row in one.comparisons if row.check.startswith(f"{figure}: ")), None)
                for one in answers]  # fmt: skip
        known = np.array([(row.effect, row.low, row.high) if row is not None else (None,) * 3
                          for row in rows], np.float64)  # fmt: skip
        for place, row in enumerate(rows):
            others: F64 = np.delete(known[:, 0], place)
            others = others[np.isfinite(others)]
            if row is None or len(others) < MIN_BESIDE - 1 or not np.isfinite(known[place]).all():
                continue
            middle = float(np.median(others))
            if figure == "gain":
                at, away = known[place] / middle, np.log(np.maximum(others / middle, 1e-9))
            else:
                at, away = known[place] - middle, others - middle
            if np.mean(np.abs(away) <= most) < _ALIKE:
                continue  # the others do not agree: it may be they
            least, high = (1 / gain, gain) if figure == "gain" else (-most, most)
            beside = _only_off(judged(
                f"{figure} beside others: {relation.name}", row.what, row.measure,
                ConfidenceInterval(*at.tolist()), logs=row.effect, twin=middle, least=least,
                most=high, logs_rows=row.logs_rows,
            ))  # fmt: skip
            one = made[place]
            changed = {figure: at[0]} if beside.off and figure != "unexplained" else {}
            made[place] = replace(one, comparisons=(*one.comparisons, beside), **changed)
    return made if relation.lags is ends.NOW else _stretches(made)


def _only_off(row: Comparison) -> Comparison:
    """Return a comparison that counts only if it is off: to differ raises no suspicion."""
    return row if row.off else replace(row, status="ok")


_WINDOW = 10  # steps of a stretch
_USUAL, _BROKEN = 0.98, 2.0  # a stretch breaks beyond so many of the others', times
_IN_PART = 0.05  # of the stretches, beyond the others'
_SPIKE, _FEW = 9.0, 0.35  # times the median square; of the rows in a broken stretch
_SHIFTS = 10  # steps
_EXPLAINED, _EXPLAINED_TOO = 0.5, 0.9  # of what is left, with what is said of broken stretches


def _stretches(answers: list[Answer]) -> list[Answer]:
    """Compare in how many stretches of a drive each robot's relation breaks, beside the others'."""
    relation = answers[0].relation
    fits = [one.found for one in answers if one.found is not None]
    if len(fits) < MIN_BESIDE - 1:
        return answers
    kernel = np.median([one.kernel for one in fits], axis=0)
    centred = relation.offset < math.inf
    offset = float(np.median([one.offset for one in fits])) if centred else 0.0
    known = [(place, one.rows) for place, one in enumerate(answers) if one.rows is not None]
    pieces = [_Pieces.of(relation, rows, kernel, offset) for _, rows in known]
    usually = np.median([one.moves.mean() for one in pieces if len(one.moves)] or [0.0])
    sizes = [np.sqrt(one.left / np.maximum(one.moves + usually, 1e-12)) for one in pieces]
    for number, (place, _) in enumerate(known):
        others = np.concatenate([size for other, size in enumerate(sizes) if other != number])
        if not len(others) or not len(sizes[number]):
            continue
        most = _BROKEN * np.quantile(others, _USUAL)
        broken, usual = sizes[number] > most, int((others > most).sum())
        row = _only_off(shares_compared(
            f"stretches: {relation.name}",
            f"stretch of {_WINDOW} steps without the answer of {relation.name}",
            (int(broken.sum()), len(broken)), (usual, len(others)), -1.0, _IN_PART,
        ))  # fmt: skip
        shape = pieces[number].shape(broken) if row.off else None
        one = answers[place]
        answers[place] = replace(one, comparisons=(*one.comparisons, row), shape=shape)
    return answers


@dataclass(frozen=True)
class _Pieces:
    """What a relation leaves unexplained in stretches of a drive."""

    expected: F64  # (N,)
    measured: F64  # (N,)
    episode: Ints  # (N,)
    at: Ints  # (n,) rows that are judged
    stretch: Ints  # (n,) codes
    left: F64  # (W,) mean square that the relation leaves
    moves: F64  # (W,) and that it expects

    @classmethod
    def of(cls, relation: Relation, rows: FedRows, kernel: F64, offset: float) -> _Pieces:
        x, measured = relation.of(rows)
        expected = lagged(x, [rows.before(int(lag)) for lag in relation.lags]) @ kernel + offset
        # A wrong pose is labelled as slip, too, but moves the robot more than its wheels turn.
        slips = np.abs(rows.after("localised_speed")) < np.abs(rows.after("wheel_speed"))
        if ends.WHEEL_TURN in (relation.x, relation.y):
            slips = np.abs(rows.after("gyro_yaw_rate")) < np.abs(wheel_turn(rows))
        known = np.isfinite(expected - measured) & ~(slips & (rows.condition == "wheel_slip"))
        stretches = int(rows.step.max(initial=0)) // _WINDOW + 1
        window = rows.episode * stretches + rows.step // _WINDOW
        _, place, count = np.unique(window[known], return_inverse=True, return_counts=True)
        enough = (count >= _WINDOW // 2)[place]
        at = np.flatnonzero(known)[enough]
        stretch = np.unique(place[enough], return_inverse=True)[1].reshape(-1)
        left, moves = (
            np.bincount(stretch, one[at] ** 2) / np.bincount(stretch)
            for one in (measured - expected, expected)
        )
        return cls(expected, measured, rows.episode, at, stretch, left, moves)

    def shape(self, broken: Bools) -> tuple[str, float] | None:
        """Return what happens in the broken stretches; None if it happens in the others as well."""
        inside = broken[self.stretch]
        p, y = self.expected[self.at], self.measured[self.at]
        square = (y - p) ** 2

        def left(other: F64, rows: Bools) -> float:
            rows = rows & np.isfinite(other)
            return float(((y - other)[rows] ** 2).sum()) / max(float(square[rows].sum()), 1e-12)

        far = square > _SPIKE * np.median(square[inside])
        few = far[inside].mean() < _FEW
        gain = float(p[inside] @ y[inside]) / max(float(p[inside] @ p[inside]), 1e-12)
        bias = float((y - p)[inside].mean())
        made = {("scaled", gain): p * gain, ("biased", bias): p + bias}
        for steps in (*range(-_SHIFTS, 0), *range(1, _SHIFTS + 1)):
            row = np.clip(self.at - steps, 0, len(self.expected) - 1)
            same = self.episode[row] == self.episode[self.at]
            made["shifted", float(steps)] = np.where(same, self.expected[row], np.nan)
        best = min(made, key=lambda one: left(made[one], inside))
        if left(made[best], inside) > _EXPLAINED:
            of_few = square[inside & ~far].sum() < _EXPLAINED * square[inside].sum()
            return ("spikes", float(far.mean())) if few and of_few else ("unlike", 0.0)
        return None if left(made[best], ~inside) < _EXPLAINED_TOO else best


HELD, ZEROS, LIMIT, ROUNDED = "held: ", "zeros: ", "limit: ", "coarse: "
FAR, FLICKER, REWARDS = "lidar far", "lidar flicker", "reward values"
_MORE = {HELD: 0.05, ZEROS: 0.02, LIMIT: 0.04, ROUNDED: 0.3, FAR: 0.1, FLICKER: 0.02, REWARDS: 0.02}
_WHAT = {
    HELD: "row in which the robot moves and the value of the row before stays",
    ZEROS: "row in which the robot moves and the value is 0",
    LIMIT: "row in which the value is its largest, which is less than others'",
    ROUNDED: "value that comes again elsewhere, as of rounding",
    FAR: "sector that sees nothing",
    FLICKER: "sector that sees something else for one row",
    REWARDS: "row's reward is not exactly the task's own",
}
_MOVES = 0.2  # of the fastest command
_EQUAL = 1e-5  # of a signal's spread
_LESS = 0.9  # of the largest value of others
_UNSEEN = 0.999  # of the lidar's entry
_JUMP, _STILL = 0.15, 0.05  # of it
_EXACT = 2e-3


class Tally(NamedTuple):
    """Rows of a robot in which something is so."""

    kind: str
    signal: str
    found: int
    of: int
    note: float = 0.0  # seconds at a time, or the largest value


def tallies(rows: FedRows) -> Iterator[Tally]:
    """Count, in one robot's rows, what is compared with other robots'."""
    command = np.abs(rows.command()) / np.maximum(np.abs(rows.task.actions).max(axis=0), 1e-9)
    drives, turns = (command > _MOVES).T
    nothing = np.full((len(rows), 3), np.nan)
    pose = rows.pose if rows.pose is not None else nothing
    for name, value, moves in (
        (ends.WHEEL_SPEED, rows.after("wheel_speed"), drives),
        (ends.WHEEL_TURN, wheel_turn(rows), turns),
        (ends.GYROSCOPE, rows.after("gyro_yaw_rate"), turns),
        (ends.ACCELEROMETER, rows.after("accel_x"), drives),
        (ends.POSE, pose[:, 0], drives),
        (ends.POSE, pose[:, 1], drives),
        (ends.POSE, pose[:, 2], turns),
        (ends.PLAN, rows.after("near_sin"), drives | turns),
        (ends.LIDAR, rows.sectors(after=True).sum(axis=1), drives | turns),
    ):  # fmt: skip
        before, known = rows.before(1)
        known &= np.isfinite(value) & moves & moves[before]
        if known.any() and np.ptp(value[np.isfinite(value)]) > 0:
            yield from _repeats(name, value, before, known, rows.task.control_period_s)
    if rows.task.lidar:
        now = rows.sectors()
        (back, first), (on, last) = rows.before(1), rows.before(-1)
        apart = np.minimum(np.abs(now - now[back]), np.abs(now - now[on]))
        alone = (apart > _JUMP) & (np.abs(now[back] - now[on]) < _STILL)
        yield Tally(FLICKER, "", int(alone[first & last].sum()), alone[first & last].size)
        seen = now[now < _UNSEEN] ** 2 * rows.task.range_max_m
        farthest = float(np.quantile(seen, 0.995)) if len(seen) else 0.0
        yield Tally(FAR, "", int((now >= _UNSEEN).mean(axis=1).sum()), len(rows), farthest)
    off = np.abs(rows.reward - implied_reward(rows))
    yield Tally(REWARDS, "", int((off > _EXACT).sum()), int(np.isfinite(off).sum()))


def _repeats(
    name: str, value: F64, before: np.ndarray, known: Bools, period_s: float
) -> Iterator[Tally]:
    finite = np.where(np.isfinite(value), value, 0.0)
    step = _EQUAL * max(float(np.subtract(*np.quantile(finite[known], [0.95, 0.05]))), 1e-9)
    code = np.unique(np.round(finite / step), return_inverse=True)[1].reshape(-1)
    same = code == code[before]
    begins = known & ~same
    comes = np.bincount(code, begins)[code]  # how often a value begins anew
    largest = float(np.abs(finite[known]).max())
    zero = np.abs(finite) < step
    limit = (np.abs(finite) > largest - step) & (comes > 1)
    held, runs = known & same & ~zero & ~limit, begins & ~zero & ~limit
    after = np.append(held[1:], False)
    times = int((runs & after).sum())
    of = int(known.sum())
    yield Tally(HELD, name, int(held.sum()), of, (1 + held.sum() / max(times, 1)) * period_s)
    yield Tally(ZEROS, name, int((known & zero).sum()), of)
    yield Tally(LIMIT, name, int((known & limit).sum()), of, largest)
    yield Tally(ROUNDED, name, int((runs & (comes > 1)).sum()), int(runs.sum()))


def signals_beside(parts: Sequence[FedRows]) -> list[list[Comparison]]:
    """Compare each robot's tallies with those of the other robot that has most."""
    made: list[list[Comparison]] = [[] for _ in parts]
    if len(parts) < MIN_BESIDE:
        return made
    each = [list(tallies(rows)) for rows in parts]
    names = {(one.kind, one.signal) for of_part in each for one in of_part}
    for kind, signal in sorted(names):
        own = [
            max((one for one in of_part if one[:2] == (kind, signal) and one.of),
                key=lambda one: one.found / one.of, default=None)
            for of_part in each
        ]  # fmt: skip
        for place, one in enumerate(own):
            others = [x for other, x in enumerate(own) if x is not None and other != place]
            if one is None or len(others) < MIN_BESIDE - 1:
                continue
            if kind in (LIMIT, FAR) and one.note > _LESS * np.median([x.note for x in others]):
                continue
            most = max(others, key=lambda x: x.found / x.of)
            row = shares_compared(
                kind + signal,
                _WHAT[kind],
                (one.found, one.of),
                (most.found, most.of),
                -1.0,
                _MORE[kind],
                f"{one.note:.2g}",
            )
            made[place].append(_only_off(row))
    return made
