"""Compare robots of a fleet with each other: relations, stretches of drives, and values.

Robots of a fleet differ less from each other than from the twin. A fault that lasts for a part of
a drive shows in its stretches, and one that replaces values shows in how these repeat.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

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
_DELAY_STEPS, _UNEXPLAINED = 0.4, 0.1  # most beside the others; the latter of the mean square


def beside_others(answers: Sequence[Answer]) -> list[Answer]:
    """Compare one relation in several robots: each with the middle of the others."""
    made = list(answers)
    if len(made) < MIN_BESIDE:
        return made
    for figure, least, most in _allowed(answers[0].relation):
        rows = [_of_figure(one, figure) for one in answers]
        for place, own in enumerate(rows):
            others = [one for other, one in enumerate(rows) if other != place and one is not None]
            if own is None or (beside := _beside(figure, own, others, least, most)) is None:
                continue
            one = made[place]
            made[place] = replace(one, comparisons=(*one.comparisons, beside))
            if beside.off and beside.effect is not None:
                if figure == "gain":
                    made[place] = replace(made[place], gain=beside.effect)
                elif figure == "delay":
                    made[place] = replace(made[place], delay=beside.effect)
    return made if answers[0].relation.lags is ends.NOW else _stretches(made)


def _allowed(relation: Relation) -> list[tuple[str, float, float]]:
    """Return the figures in which robots may be compared, and their ranges beside the others."""
    if relation.y == ends.PLAN:  # where robots are sent differs
        return []
    gain = GAIN if relation.most == ends.ALIKE else NOISY if relation.gain is None else ANSWER
    return [
        ("gain", 1 / gain, gain),
        ("delay", -_DELAY_STEPS, _DELAY_STEPS),
        ("unexplained", -_UNEXPLAINED, _UNEXPLAINED),
    ]


def _of_figure(answer: Answer, figure: str) -> Comparison | None:
    """Return a robot's own comparison of a figure; None if it has none."""
    return next((row for row in answer.comparisons if row.check.startswith(f"{figure}: ")), None)


def _beside(
    figure: str, own: Comparison, others: Sequence[Comparison], least: float, most: float
) -> Comparison | None:
    """Compare a figure with the middle of the others'; None if these are few or do not agree.

    Gains are compared by their ratio, other figures by their difference.
    """
    values = np.array([one.effect for one in others], np.float64)  # NaN for None
    values = values[np.isfinite(values)]
    at = np.array([own.effect, own.low, own.high], np.float64)
    if len(values) < MIN_BESIDE - 1 or not np.isfinite(at).all():
        return None
    middle = float(np.median(values))
    if figure == "gain":
        at, away, far = at / middle, np.log(np.maximum(values / middle, 1e-9)), math.log(most)
    else:
        at, away, far = at - middle, values - middle, most
    if np.mean(np.abs(away) <= far) < _ALIKE:
        return None  # it may be they
    name = own.check.removeprefix(f"{figure}: ")
    return _only_off(
        judged(
            f"{figure} beside others: {name}",
            own.what,
            own.measure,
            ConfidenceInterval(*at.tolist()),
            logs=own.effect,
            twin=middle,
            least=least,
            most=most,
            logs_rows=own.logs_rows,
        )
    )


def _only_off(row: Comparison) -> Comparison:
    """Return a comparison that counts only if it is off: to differ raises no suspicion."""
    return row if row.off else replace(row, status="ok")


_WINDOW = 10  # steps of a stretch
_USUAL, _BROKEN = 0.98, 2.0  # a stretch is broken beyond this quantile of the others', times
_IN_PART = 0.05  # of the stretches, beyond the others'
_SPIKE, _FEW = 9.0, 0.35  # times the median square; of the rows in a broken stretch
_SHIFTS = 10  # steps
_EXPLAINED, _EXPLAINED_TOO = 0.5, 0.9  # of what is left, with what is said of broken stretches


def _stretches(answers: list[Answer]) -> list[Answer]:
    """Compare in how many stretches of a drive each robot's relation breaks, beside the others'.

    All are held against one response: the middle of the robots' own.
    """
    relation = answers[0].relation
    fits = [one.found for one in answers if one.found is not None]
    if len(fits) < MIN_BESIDE - 1:
        return answers
    kernel = np.median([one.kernel for one in fits], axis=0)
    centred = relation.offset < math.inf
    offset = float(np.median([one.offset for one in fits])) if centred else 0.0
    drives = {
        place: Stretches.of(relation, one.rows, kernel, offset)
        for place, one in enumerate(answers)
        if one.rows is not None
    }
    usually = np.median([one.moves.mean() for one in drives.values() if len(one.moves)] or [0.0])
    errors = {place: one.relative_error(float(usually)) for place, one in drives.items()}
    for place, drive in drives.items():
        others = np.concatenate([error for other, error in errors.items() if other != place])
        if not len(others) or not len(errors[place]):
            continue
        most = _BROKEN * np.quantile(others, _USUAL)
        broken, usual = errors[place] > most, int((others > most).sum())
        row = _only_off(
            shares_compared(
                f"stretches: {relation.name}",
                f"stretch of {_WINDOW} steps without the answer of {relation.name}",
                (int(broken.sum()), len(broken)),
                (usual, len(others)),
                -1.0,
                _IN_PART,
            )
        )
        one = answers[place]
        shape = drive.shape(broken) if row.off else None
        answers[place] = replace(one, comparisons=(*one.comparisons, row), shape=shape)
    return answers


@dataclass(frozen=True)
class Stretches:
    """What a relation expects of a robot, and leaves unexplained, in W stretches of its drives."""

    expected: F64  # (N,) by the relation
    measured: F64  # (N,)
    episode: Ints  # (N,)
    at: Ints  # (n,) rows that are judged
    stretch: Ints  # (n,) codes
    left: F64  # (W,) mean square that the relation leaves
    moves: F64  # (W,) and that it expects

    @classmethod
    def of(cls, relation: Relation, rows: FedRows, kernel: F64, offset: float) -> Stretches:
        """Cut a robot's rows; wheels that slip are no fault, and stretches of few rows are none."""
        x, measured = relation.of(rows)
        expected = lagged(x, [rows.before(int(lag)) for lag in relation.lags]) @ kernel + offset
        # A wrong pose is labelled as slip, too, but moves the robot more than its wheels turn.
        slips = np.abs(rows.after("localised_speed")) < np.abs(rows.after("wheel_speed"))
        if ends.WHEEL_TURN in (relation.x, relation.y):
            slips = np.abs(rows.after("gyro_yaw_rate")) < np.abs(wheel_turn(rows))
        known = np.isfinite(expected - measured) & ~(slips & (rows.condition == "wheel_slip"))
        windows = int(rows.step.max(initial=0)) // _WINDOW + 1  # of an episode, at most
        window = rows.episode * windows + rows.step // _WINDOW
        _, place, count = np.unique(window[known], return_inverse=True, return_counts=True)
        enough = (count >= _WINDOW // 2)[place]
        at = np.flatnonzero(known)[enough]
        stretch = np.unique(place[enough], return_inverse=True)[1].reshape(-1)
        left, moves = (
            np.bincount(stretch, one[at] ** 2) / np.bincount(stretch)
            for one in (measured - expected, expected)
        )
        return cls(expected, measured, rows.episode, at, stretch, left, moves)

    def relative_error(self, usually: float) -> F64:
        """Return how far off each stretch is (W,), over how much it moves and is usual to move."""
        return np.sqrt(self.left / np.maximum(self.moves + usually, 1e-12))

    def shape(self, broken: Bools) -> tuple[str, float] | None:
        """Return what explains the broken stretches, and by how much it does.

        That is the best of `_explanations`; "spikes" or "unlike" if none is good, and None if the
        best explains the other stretches as well.

        Args:
            broken: (W,)
        """
        inside = broken[self.stretch]
        measured = self.measured[self.at]
        square = (measured - self.expected[self.at]) ** 2

        def left(values: F64, rows: Bools) -> float:
            """Return the part of the error that is left with other expected values."""
            rows = rows & np.isfinite(values)
            error = float(((measured - values)[rows] ** 2).sum())
            return error / max(float(square[rows].sum()), 1e-12)

        explained = self._explanations(inside)
        best = min(explained, key=lambda one: left(explained[one], inside))
        if left(explained[best], inside) <= _EXPLAINED:
            return None if left(explained[best], ~inside) < _EXPLAINED_TOO else best
        far = square > _SPIKE * np.median(square[inside])
        is_few = far[inside].mean() < _FEW
        most_of_it = square[inside & ~far].sum() < _EXPLAINED * square[inside].sum()
        return ("spikes", float(far.mean())) if is_few and most_of_it else ("unlike", 0.0)

    def _explanations(self, inside: Bools) -> dict[tuple[str, float], F64]:
        """Return what a scale, a bias or a delay would let one expect, (n,) each, with its size.

        Scale and bias are those of the rows `inside` (n,).
        """
        expected, measured = self.expected[self.at], self.measured[self.at]
        p, y = expected[inside], measured[inside]
        scale = float(p @ y) / max(float(p @ p), 1e-12)
        bias = float((y - p).mean())
        made = {("scaled", scale): expected * scale, ("biased", bias): expected + bias}
        for steps in (*range(-_SHIFTS, 0), *range(1, _SHIFTS + 1)):
            row = np.clip(self.at - steps, 0, len(self.expected) - 1)
            same = self.episode[row] == self.episode[self.at]
            made["shifted", float(steps)] = np.where(same, self.expected[row], np.nan)
        return made


HELD, ZEROS, LIMIT, ROUNDED = "held: ", "zeros: ", "limit: ", "coarse: "
FAR, FLICKER, REWARDS = "lidar far", "lidar flicker", "reward values"


@dataclass(frozen=True)
class _Kind:
    """A kind of tally: what is counted, and how much more than the others' is too much."""

    what: str
    most: float


_KINDS = {
    HELD: _Kind("row in which the robot moves and the value of the row before stays", 0.05),
    ZEROS: _Kind("row in which the robot moves and the value is 0", 0.02),
    LIMIT: _Kind("row in which the value is its largest, which is less than others'", 0.04),
    ROUNDED: _Kind("value that comes again elsewhere, as of rounding", 0.3),
    FAR: _Kind("sector that sees nothing", 0.1),
    FLICKER: _Kind("sector that sees something else for one row", 0.02),
    REWARDS: _Kind("row's reward is not exactly the task's own", 0.02),
}
_MOVES = 0.2  # of the fastest command
_EQUAL = 1e-5  # of a signal's spread
_LESS = 0.9  # of the largest value of others
_UNSEEN = 0.999  # of the lidar's entry
_JUMP, _STILL = 0.15, 0.05  # of it
_EXACT = 2e-3


@dataclass(frozen=True)
class Tally:
    """How many rows of a robot are so, of those that could be."""

    kind: str
    signal: str  # an end of the relations; "" where the kind has one signal alone
    found: int
    of: int
    note: float = 0.0  # seconds at a time, or the largest value

    @property
    def share(self) -> float:
        return self.found / self.of


def tallies(rows: FedRows) -> Iterator[Tally]:
    """Count, in one robot's rows, what is compared with other robots'."""
    for signal, value, moves in _signals(rows):
        before, known = rows.before(1)
        known &= np.isfinite(value) & moves & moves[before]
        if known.any() and np.ptp(value[np.isfinite(value)]) > 0:
            yield from _repeats(signal, value, before, known, rows.task.control_period_s)
    if rows.task.lidar:
        yield from _of_lidar(rows)
    off = np.abs(rows.reward - implied_reward(rows))
    yield Tally(REWARDS, "", int((off > _EXACT).sum()), int(np.isfinite(off).sum()))


def _signals(rows: FedRows) -> Iterator[tuple[str, F64, Bools]]:
    """Yield a signal's name, its values (N,), and in which rows it should change."""
    command = np.abs(rows.command()) / np.maximum(np.abs(rows.task.actions).max(axis=0), 1e-9)
    drives, turns = (command > _MOVES).T
    yield ends.WHEEL_SPEED, rows.after("wheel_speed"), drives
    yield ends.WHEEL_TURN, wheel_turn(rows), turns
    yield ends.GYROSCOPE, rows.after("gyro_yaw_rate"), turns
    yield ends.ACCELEROMETER, rows.after("accel_x"), drives
    if rows.pose is not None:
        yield ends.POSE, rows.pose[:, 0], drives
        yield ends.POSE, rows.pose[:, 1], drives
        yield ends.POSE, rows.pose[:, 2], turns
    yield ends.PLAN, rows.after("near_sin"), drives | turns
    yield ends.LIDAR, rows.sectors(after=True).sum(axis=1), drives | turns


def _repeats(
    signal: str, value: F64, before: Ints, known: Bools, period_s: float
) -> Iterator[Tally]:
    """Count how the values (N,) of a signal repeat, in `known` rows; `before` is the row before."""
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
    yield Tally(HELD, signal, int(held.sum()), of, (1 + held.sum() / max(times, 1)) * period_s)
    yield Tally(ZEROS, signal, int((known & zero).sum()), of)
    yield Tally(LIMIT, signal, int((known & limit).sum()), of, largest)
    yield Tally(ROUNDED, signal, int((runs & (comes > 1)).sum()), int(runs.sum()))


def _of_lidar(rows: FedRows) -> Iterator[Tally]:
    """Count sectors that differ for one row from the rows around it, or that see nothing."""
    now = rows.sectors()
    (back, first), (on, last) = rows.before(1), rows.before(-1)
    apart = np.minimum(np.abs(now - now[back]), np.abs(now - now[on]))
    alone = (apart > _JUMP) & (np.abs(now[back] - now[on]) < _STILL)
    yield Tally(FLICKER, "", int(alone[first & last].sum()), alone[first & last].size)
    seen = now[now < _UNSEEN] ** 2 * rows.task.range_max_m
    farthest = float(np.quantile(seen, 0.995)) if len(seen) else 0.0
    yield Tally(FAR, "", int((now >= _UNSEEN).mean(axis=1).sum()), len(rows), farthest)


def signals_beside(parts: Sequence[FedRows]) -> list[list[Comparison]]:
    """Compare each robot's tallies with those of the other robot that has most."""
    made: list[list[Comparison]] = [[] for _ in parts]
    if len(parts) < MIN_BESIDE:
        return made
    each = [_largest(tallies(rows)) for rows in parts]
    for key in sorted({key for of_part in each for key in of_part}):
        for place, of_part in enumerate(each):
            others = [
                of_other[key]
                for other, of_other in enumerate(each)
                if other != place and key in of_other
            ]
            if key not in of_part or len(others) < MIN_BESIDE - 1:
                continue
            own, (kind, signal) = of_part[key], key
            if kind in (LIMIT, FAR) and own.note > _LESS * np.median([one.note for one in others]):
                continue
            most = max(others, key=lambda one: one.share)
            row = shares_compared(
                kind + signal,
                _KINDS[kind].what,
                (own.found, own.of),
                (most.found, most.of),
                -1.0,
                _KINDS[kind].most,
                f"{own.note:.2g}",
            )
            made[place].append(_only_off(row))
    return made


def _largest(each: Iterator[Tally]) -> dict[tuple[str, str], Tally]:
    """Return the tallies by kind and signal: of several of one signal, the largest share."""
    found: dict[tuple[str, str], Tally] = {}
    for one in each:
        key = one.kind, one.signal
        if one.of and (key not in found or one.share > found[key].share):
            found[key] = one
    return found
