"""Compare robots of a fleet with each other: relations, stretches of drives, and values.

Robots of a fleet differ less from each other than from the twin. A fault that lasts for part of a
drive shows in some stretches of it. A fault that replaces values shows in how often these repeat.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from restock.arrays import F64, Bools, Ints
from restock.ingest.task.task import proposal_reader
from restock.stats import ConfidenceInterval
from restock.train.judge import answers as ends
from restock.train.judge.answers import Answer, Broken, Relation, lagged, wheel_turn
from restock.train.judge.fed_rows import Comparison, FedRows, judged, shares_compared
from restock.train.judge.row_checks import implied_reward

MIN_BESIDE = 4  # fewest robots or recordings that can be compared with each other
_MIN_AGREEING = 0.75  # least share of the other robots that must agree with their median
GAIN = 1.02  # largest ratio to the others' gain, either way, for two sensors of the same motion
ANSWER, NOISY = 1.15, 1.25  # `GAIN` for other relations of like quantities, and of unlike ones
_DELAY_STEPS, _UNEXPLAINED = 0.4, 0.1  # largest differences of delay and unexplained share


def beside_others(
    parts: Sequence[FedRows], answers: Sequence[Sequence[Answer]]
) -> list[list[Comparison]]:
    """Compare the relations and the repeated values of each robot with those of the others.

    Adds comparisons of relations to `answers`, and returns those of values, per robot.
    """
    if len(parts) < MIN_BESIDE:
        return [[] for _ in parts]
    each = [_merge_tallies(tallies(rows)) for rows in parts]
    values = _compare_tallies(each)
    off = [{row.check for row in of_part if row.off} for of_part in values]
    odd = [
        {"".join(key): one for key, one in of_part.items() if "".join(key) in names}
        for of_part, names in zip(each, off, strict=True)
    ]
    for of_relation in zip(*answers, strict=True):
        _compare_relation(of_relation)
        if of_relation[0].relation.lags is not ends.NOW:
            _compare_stretches(of_relation, odd)
    return values


def _compare_relation(answers: Sequence[Answer]) -> None:
    """Compare each robot's figures of one relation with the median of the others."""
    for figure, least, most in _allowed(answers[0].relation):
        rows = [_find_comparison(one, figure) for one in answers]
        for place, own in enumerate(rows):
            others = [one for other, one in enumerate(rows) if other != place and one is not None]
            if own is None or (beside := _compare_figure(figure, own, others, least, most)) is None:
                continue
            answers[place].comparisons.append(beside)
            if beside.off and beside.effect is not None and figure != "unexplained":
                setattr(answers[place], figure, beside.effect)


def _allowed(relation: Relation) -> list[tuple[str, float, float]]:
    """Return the figures to compare between robots, with the allowed range of each."""
    if relation.y == ends.PLAN:  # robots are sent to different places
        return []
    gain = GAIN if relation.most == ends.ALIKE else ANSWER if relation.defined else NOISY
    return [
        ("gain", 1 / gain, gain),
        ("delay", -_DELAY_STEPS, _DELAY_STEPS),
        ("unexplained", -_UNEXPLAINED, _UNEXPLAINED),
    ]


def _find_comparison(answer: Answer, figure: str) -> Comparison | None:
    """Return the robot's comparison of a figure with the twin; None if there is none."""
    return next((row for row in answer.comparisons if row.check.startswith(f"{figure}: ")), None)


def _compare_figure(
    figure: str, own: Comparison, others: Sequence[Comparison], least: float, most: float
) -> Comparison | None:
    """Compare a figure with the median of the others; None if the others are too few or disagree.

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
    if np.mean(np.abs(away) <= far) < _MIN_AGREEING:
        return None  # the others may be wrong
    name = own.check.removeprefix(f"{figure}: ")
    return _accept_undecided(
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


def _accept_undecided(row: Comparison) -> Comparison:
    """Turn "undecided" into "ok": robots may differ somewhat without raising suspicion."""
    if not row.off:
        row.status = "ok"
    return row


_WINDOW = 10  # steps of a stretch
_USUAL, _BROKEN = 0.98, 2.0  # a stretch breaks at 2 x the others' 0.98 quantile of errors
_MAX_BROKEN = 0.05  # largest share of broken stretches, after subtracting the others' share
_MAX_SPIKES = 0.25  # errors are spikes if a smaller share of the broken stretches' rows has them
_MIN_WEIGHT = 0.1  # lags with a smaller share of the kernel's largest weight are ignored
_SHIFTS = (*range(-10, 0), *range(1, 11))  # shifts in steps that are tried to mend broken stretches


def _compare_stretches(answers: Sequence[Answer], odd: Sequence[Mapping[str, Tally]]) -> None:
    """Compare the share of stretches in which a relation breaks: each robot's with the others'.

    All stretches are compared with one response: the median of the robots' fits. `odd` has the
    tallies of each robot that are off, by check.
    """
    relation = answers[0].relation
    fits = [one.found for one in answers if one.found is not None]
    if len(fits) < MIN_BESIDE - 1:
        return
    kernel = np.median([one.kernel for one in fits], axis=0)
    centred = relation.offset < math.inf
    offset = float(np.median([one.offset for one in fits])) if centred else 0.0
    drives = {
        place: Stretches.of(relation, one.rows, kernel, offset)
        for place, one in enumerate(answers)
        if one.rows is not None
    }
    usually = float(np.median([one.moves.mean() for one in drives.values() if len(one.moves)] or 0))
    errors = {place: one.relative_error(usually) for place, one in drives.items()}
    for place, drive in drives.items():
        others = [other for other in drives if other != place]
        error = np.concatenate([errors[other] for other in others])
        if not len(error) or not len(errors[place]):
            continue
        most = _BROKEN * float(np.quantile(error, _USUAL))
        broken = errors[place] > most
        row = _accept_undecided(
            shares_compared(
                f"stretches: {relation.name}",
                f"stretch of {_WINDOW} steps without the answer of {relation.name}",
                (int(broken.sum()), len(broken)),
                (int((error > most).sum()), len(error)),
                -1.0,
                _MAX_BROKEN,
            )
        )
        answers[place].comparisons.append(row)
        if row.off:
            usual = np.concatenate([drives[other].left for other in others]).mean()
            mended = drive.mended(broken, most, usually, _odd_rows(relation, kernel, odd[place]))
            off_by = drive.left[broken].mean() ** 0.5
            answers[place].broken = Broken(off_by, usual**0.5, mended)


def _odd_rows(relation: Relation, kernel: F64, odd: Mapping[str, Tally]) -> dict[str, Bools]:
    """Return, by check, which rows (N,) use an odd value of one of the relation's signals."""
    lags = relation.lags[np.abs(kernel) > _MIN_WEIGHT * np.abs(kernel).max()]
    found = {}
    for check, one in odd.items():
        if one.rows is None or one.signal not in (relation.x, relation.y):
            continue
        if one.signal == relation.x:
            found[check] = np.any([np.roll(one.rows, lag) for lag in lags], axis=0)
        else:  # the pose's motion in a row also uses the next row's pose
            after = np.append(one.rows[1:], False) & (one.signal == ends.POSE)
            found[check] = one.rows | after
    return found


@dataclass(frozen=True)
class Stretches:
    """Expected and measured y of one robot and relation, cut into W stretches of its drives."""

    expected: F64  # (N,) y that the relation predicts
    measured: F64  # (N,) y in the logs
    episode: Ints  # (N,)
    at: Ints  # (n,) rows that are judged
    stretch: Ints  # (n,) number of each judged row's stretch, 0 to W - 1
    left: F64  # (W,) mean square error of the relation
    moves: F64  # (W,) mean square of the expected y

    @classmethod
    def of(cls, relation: Relation, rows: FedRows, kernel: F64, offset: float) -> Stretches:
        """Cut a robot's rows into stretches; omit rows that slip, then half-empty stretches."""
        x, measured = relation.of(rows)
        expected = lagged(x, [rows.before(int(lag)) for lag in relation.lags]) @ kernel + offset
        # Rows with a wrong pose are labelled as slip, too, but there the pose outruns the wheels.
        slips = np.abs(rows.after("localised_speed")) < np.abs(rows.after("wheel_speed"))
        if ends.WHEEL_TURN in (relation.x, relation.y):
            slips = np.abs(rows.after("gyro_yaw_rate")) < np.abs(wheel_turn(rows))
        known = np.isfinite(expected - measured) & ~(slips & (rows.condition == "wheel_slip"))
        windows = int(rows.step.max(initial=0)) // _WINDOW + 1  # most windows in an episode
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
        """Return each stretch's RMS error, (W,), relative to its own plus the usual motion."""
        return np.sqrt(self.left / np.maximum(self.moves + usually, 1e-12))

    def mended(
        self, broken: Bools, most: float, usually: float, odd: Mapping[str, Bools]
    ) -> dict[str, tuple[float, float]]:
        """Return, by cause, the share of broken stretches that hold if it is undone, and its size.

        Args:
            broken: which stretches (W,) break.
            most: relative error up to which a stretch holds.
            usually: usual mean square of the expected y.
            odd: rows (N,) that use odd values, by check; each check is a cause that is undone by
                leaving out its rows.
        """
        inside = broken[self.stretch]
        expected, measured = self.expected[self.at], self.measured[self.at]
        p, y = expected[inside], measured[inside]
        scale = float(p @ y) / max(float(p @ p), 1e-12)
        bias = float((y - p).mean())
        made: dict[str, list[tuple[float, F64]]] = {
            "shifted": [(float(steps), self._expected_earlier(steps)) for steps in _SHIFTS],
            "scaled": [(scale, expected * scale)],
            "biased": [(bias, expected + bias)],
        }
        far = (measured - expected) ** 2 > most**2 * (expected**2 + usually)
        if far[inside].mean() < _MAX_SPIKES:
            made["spikes"] = [(float(far.mean()), np.where(far, np.nan, expected))]
        for check, rows in odd.items():
            if (inside & ~rows[self.at]).any():
                made[check] = [(0.0, np.where(rows[self.at], np.nan, expected))]
        return {
            cause: max(
                ((self._share_held(values, broken, most, usually), by) for by, values in each),
                key=lambda one: one[0],
            )
            for cause, each in made.items()
        }

    def _expected_earlier(self, steps: int) -> F64:
        """Return the expected y `steps` earlier, (n,); NaN if that step is in another episode."""
        row = np.clip(self.at - steps, 0, len(self.expected) - 1)
        same = self.episode[row] == self.episode[self.at]
        return np.where(same, self.expected[row], np.nan)

    def _share_held(self, expected: F64, broken: Bools, most: float, usually: float) -> float:
        """Return the share of broken stretches that would hold with these expected values (n,).

        Rows with NaN are left out.
        """
        known = np.isfinite(expected)
        stretch, expected = self.stretch[known], expected[known]
        square = (self.measured[self.at][known] - expected) ** 2
        count, left, moves = (
            np.bincount(stretch, weights, len(broken)) for weights in (None, square, expected**2)
        )
        holds = left <= most**2 * (moves + count * usually)
        judged_ones = broken & (count > 0)
        return float(holds[judged_ones].mean()) if judged_ones.any() else 0.0


HELD, ZEROS, LIMIT, ROUNDED, COPIED = "held: ", "zeros: ", "limit: ", "coarse: ", "copied: "
FAR, FLICKER, REWARDS = "lidar far", "lidar flicker", "reward values"
PROPOSED, REPLACED = "proposed: ", "goals replaced"


@dataclass(frozen=True)
class _Kind:
    """A kind of tally: what is counted, and by how much its share may exceed other robots'."""

    what: str  # for people
    most: float


_KINDS = {
    COPIED: _Kind("row in which the robot moves and the value is exactly another signal's", 0.05),
    PROPOSED: _Kind("action of a driver that equals navigation's proposal", 0.1),
    REPLACED: _Kind("episode whose goal is replaced before it is reached", 0.1),
    HELD: _Kind("row in which the robot moves and the value equals that of the row before", 0.05),
    ZEROS: _Kind("row in which the robot moves and the value is 0", 0.02),
    LIMIT: _Kind("row in which the value is at its maximum, which other robots exceed", 0.04),
    ROUNDED: _Kind("value that comes again elsewhere, as if rounded", 0.3),
    FAR: _Kind("sector that sees nothing", 0.1),
    FLICKER: _Kind("sector that sees something else for one row", 0.02),
    REWARDS: _Kind("row's reward is not exactly the task's own", 0.02),
}
_MOVES = 0.2  # commands above this share of the fastest one should move the robot
_EQUAL = 1e-5  # values equal each other up to this share of their signal's spread
_SAME = 1e-4  # two signals equal each other up to this difference, in m/s or rad/s
_MIN_DRIVEN = 100  # least rows of a driver whose actions are counted
_LESS = 0.9  # a robot's maximum is odd only below this share of the others' median
_UNSEEN = 0.999  # lidar entries of at least this saw nothing
_JUMP, _STILL = 0.15, 0.05  # a flicker is over _JUMP from both neighbours, these within _STILL
_EXACT = 2e-3  # a reward differs from the task's own if it is off by more than this


@dataclass(frozen=True)
class Tally:
    """A count of a robot's rows, values or episodes with some oddity: `found` of `of`."""

    kind: str  # a key of `_KINDS`
    signal: str  # a signal of the relations, or a driver; "" if the kind needs none
    found: int
    of: int
    size: float = 0.0  # `HELD`: seconds that a value lasts; `LIMIT`, `FAR`: the largest value
    rows: Bools | None = None  # (N,) which rows are odd; None if relations cannot skip them
    note: str = ""

    @property
    def share(self) -> float:
        return self.found / self.of


def tallies(rows: FedRows) -> Iterator[Tally]:
    """Count the oddities in one robot's rows that are compared between robots."""
    copied: dict[str, Bools] = {}
    for signal, moves, same, note in _copies(rows):
        copied[signal] = same
        yield Tally(COPIED, signal, int(same.sum()), int(moves.sum()), note=note)
    for signal, value, moves in _signals(rows):
        before, known = rows.before(1)
        known &= np.isfinite(value) & moves & moves[before]
        if known.any() and np.ptp(value[np.isfinite(value)]) > 0:
            period_s, same = rows.task.control_period_s, copied.get(signal, np.zeros_like(known))
            yield from _tally_repeats(signal, value, before, known, same, period_s)
    if rows.task.lidar:
        yield from _tally_lidar(rows)
    yield from _tally_drivers(rows)
    yield from _tally_goals(rows)
    off = np.abs(rows.reward - implied_reward(rows))
    yield Tally(REWARDS, "", int((off > _EXACT).sum()), int(np.isfinite(off).sum()))


def _signals(rows: FedRows) -> Iterator[tuple[str, F64, Bools]]:
    """Yield each signal's name, its values (N,), and in which rows (N,) it should change."""
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


def _tally_repeats(
    signal: str, value: F64, before: Ints, known: Bools, copied: Bools, period_s: float
) -> Iterator[Tally]:
    """Count how the values (N,) of a signal repeat in `known` rows.

    `before` is the index of each row's predecessor. `copied` values do not count as rounded.
    """
    finite = np.where(np.isfinite(value), value, 0.0)
    step = _EQUAL * max(float(np.subtract(*np.quantile(finite[known], [0.95, 0.05]))), 1e-9)
    code = np.unique(np.round(finite / step), return_inverse=True)[1].reshape(-1)
    same = code == code[before]
    begins = known & ~same
    comes = np.bincount(code, begins)[code]  # how many separate times the value occurs
    largest = float(np.abs(finite[known]).max())
    zero = np.abs(finite) < step
    limit = (np.abs(finite) > largest - step) & (comes > 1)
    stays = same & ~zero & ~limit
    held, runs = known & stays, begins & ~zero & ~limit
    after = np.append(held[1:], False)
    times = int((runs & after).sum())
    of = int(known.sum())
    for kind, found, rows, size in (
        (HELD, held, stays, (1 + held.sum() / max(times, 1)) * period_s),
        (ZEROS, known & zero, zero, 0.0),
        (LIMIT, known & limit, limit, largest),
    ):
        yield Tally(kind, signal, int(found.sum()), of, size, rows)
    runs &= ~copied
    yield Tally(ROUNDED, signal, int((runs & (comes > 1)).sum()), int(runs.sum()))


def _copies(rows: FedRows) -> Iterator[tuple[str, Bools, Bools, str]]:
    """Yield signals that may copy another: name, moving rows (N,), copied rows, other's name."""
    speed, turn = rows.command().T
    for signal, value, other, of in (
        (ends.WHEEL_SPEED, rows.after("wheel_speed"), speed, "the command"),
        (ends.WHEEL_TURN, wheel_turn(rows), turn, "the command"),
        (ends.GYROSCOPE, rows.after("gyro_yaw_rate"), wheel_turn(rows), "the wheels' turn"),
        (ends.POSE, rows.after("localised_speed"), rows.after("wheel_speed"), "the wheels' speed"),
    ):
        moves = np.abs(value) > _SAME
        yield signal, moves, moves & (np.abs(value - other) < _SAME), of


def _tally_drivers(rows: FedRows) -> Iterator[Tally]:
    """Count, for each driver, the actions that are nearest to navigation's proposal."""
    near, offset, says = proposal_reader(rows.task)
    nearest = (rows.observation @ near.T + offset).argmax(axis=1)
    known = rows.observation @ says > 0.5
    for name in np.unique(rows.driver[known]).tolist() if rows.driver is not None else ():
        own = known & (rows.driver == name)
        if name and own.sum() >= _MIN_DRIVEN:
            same = int((own & (nearest == rows.action)).sum())
            yield Tally(PROPOSED, name, same, int(own.sum()), note=name)


def _tally_goals(rows: FedRows) -> Iterator[Tally]:
    """Count truncated episodes after which the recording goes on at the next step."""
    recording = np.unique(rows.recording, return_inverse=True)[1].reshape(-1)
    order = np.lexsort((rows.logged_ns, recording))
    later_s = np.diff(rows.logged_ns[order]) * 1e-9
    goes_on = np.zeros(len(rows), np.bool_)
    goes_on[order[:-1]] = (later_s > 0) & (later_s < 1.5 * rows.task.control_period_s)
    goes_on[order[:-1]] &= np.diff(recording[order]) == 0
    cut = rows.last & rows.truncated & goes_on
    yield Tally(REPLACED, "", int(cut.sum()), int(rows.last.sum()))


def _tally_lidar(rows: FedRows) -> Iterator[Tally]:
    """Count sectors that differ for one row from the rows around it, see nothing, or read 0."""
    now = rows.sectors()
    (back, first), (on, last) = rows.before(1), rows.before(-1)
    apart = np.minimum(np.abs(now - now[back]), np.abs(now - now[on]))
    alone = (apart > _JUMP) & (np.abs(now[back] - now[on]) < _STILL)
    yield Tally(FLICKER, "", int(alone[first & last].sum()), alone[first & last].size)
    seen = now[now < _UNSEEN] ** 2 * rows.task.range_max_m
    farthest = float(np.quantile(seen, 0.995)) if len(seen) else 0.0
    yield Tally(FAR, "", int((now >= _UNSEEN).mean(axis=1).sum()), len(rows), farthest)
    moves = np.abs(rows.after("wheel_speed")) > _SAME
    zero = moves & (now == 0.0).any(axis=1)
    yield Tally(ZEROS, ends.LIDAR, int(zero.sum()), int(moves.sum()))


def _compare_tallies(each: Sequence[dict[tuple[str, str], Tally]]) -> list[list[Comparison]]:
    """Compare each tally of a robot with the largest one among the others."""
    made: list[list[Comparison]] = [[] for _ in each]
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
            if kind in (LIMIT, FAR) and own.size > _LESS * np.median([one.size for one in others]):
                continue
            most = max(others, key=lambda one: one.share)
            row = shares_compared(
                kind + signal,
                _KINDS[kind].what,
                (own.found, own.of),
                (most.found, most.of),
                -1.0,
                _KINDS[kind].most,
                own.note or f"{own.size:.2g}",
            )
            made[place].append(_accept_undecided(row))
    return made


def _merge_tallies(each: Iterator[Tally]) -> dict[tuple[str, str], Tally]:
    """Return tallies by kind and signal; of several with the same key, that with the largest share.

    The `rows` of this tally are the union of the rows of all of them.
    """
    found: dict[tuple[str, str], Tally] = {}
    for one in each:
        key = one.kind, one.signal
        if one.of:
            other = found.get(key, one)
            most = max(other, one, key=lambda tally: tally.share)
            if one.rows is not None and other.rows is not None:
                most = replace(most, rows=one.rows | other.rows)
            found[key] = most
    return found
