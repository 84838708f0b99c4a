"""Infer what is wrong with logs from the comparisons that are off, in their owner's words.

A sensor whose readings are scaled, turned round or late is off in every relation that it takes part
in, and the others agree among themselves. So the smallest set of ends that all failing relations
share is at fault.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from statistics import median
from typing import Any

import msgspec

from restock.ingest.task.task import Task
from restock.train.judge.answers import (
    ACTION_SPEED,
    ACTION_TURN,
    DELAY_STEPS,
    GAIN,
    LIDAR,
    PLAN,
    POSE,
    WHEEL_SPEED,
    WHEEL_TURN,
    Answer,
)
from restock.train.judge.beside import HELD, LIMIT, ROUNDED, ZEROS
from restock.train.judge.fed_rows import Comparison
from restock.train.judge.mission_checks import CHOSEN

GROUPS = {"actions": (ACTION_SPEED, ACTION_TURN), "wheels": (WHEEL_SPEED, WHEEL_TURN)}
GOALS = "GOALS_OF_OTHERS"
_FIRST = (  # nothing can be told of rows before these
    *("ROWS_APART", "ROWS_UNCHANGED", "FUTURE_IN_OBSERVATION"),
)
OF_SIGNALS = (LIMIT, ZEROS, ROUNDED, HELD)  # what one value shows, first what explains the others
_OPPOSITE, _NONE = -0.6, 0.3  # of what is expected, at most
_MOST = 0.8  # of the missions: a signal that is wrong in nearly all of them is wrong alike in all
CHANGED = "ACTIONS_CHANGED"  # then nothing that actions show is the profile's fault
COARSE = "ACTIONS_COARSE"  # then actions explain less of the motion, whatever else is right
_ON_THEIR_OWN = ("EPISODES_REPEATED", "TERMINATIONS_WRONG")
_UNITS = (
    ((50.0, 65.0), "degrees in place of radians"),
    ((3.2, 4.0), "km/h in place of m/s"),
    ((85.0, 115.0), "centimetres in place of metres"),
    ((850.0, 1150.0), "millimetres in place of metres"),
)


@dataclass(frozen=True)
class Finding:
    """A fault in the logs' rows."""

    cause: str  # a name that docs and programs know it by
    text: str  # what, by how much
    remedy: str
    evidence: tuple[str, ...]  # the comparisons it rests on, by `check`


def findings(
    answers: Sequence[Answer],
    permuted: Sequence[tuple[Comparison, int]],
    others: Iterable[Comparison],
    task: Task,
) -> list[Finding]:
    """Return the faults, the least understood last."""
    of_signals: dict[str, Comparison] = {}  # by the kind of check, and the signal
    rest = []
    for row in others:
        if row.off and row.check.startswith(OF_SIGNALS):
            of_signals[row.check] = row
        elif row.off:
            rest.append(row)
    of_rows = _of_rows(rest)
    first = [one for one in of_rows if one.cause in _FIRST]
    if first:  # what rows are made of, and all that is compared with their next, follows from it
        return first + [one for one in of_rows if one.cause in _ON_THEIR_OWN]
    found, shown = _of_signals(of_signals, of_rows, answers)
    ends = odd_ends([one for one in answers if not _has(one, shown)])
    moved = [(row, place, other) for place, (row, other) in enumerate(permuted) if other != place]
    one_to_one = len({other for _, _, other in moved}) == len(moved)
    actions = [end for end in ends if end in (ACTION_SPEED, ACTION_TURN, "actions")]
    # Actions that are late or early are found in place of others, too.
    shifted = any(_is_shift(*_distortion(end, ends[end])) for end in actions)
    changed = [one for one in of_rows if one.cause == CHANGED]
    shifted |= WHEEL_SPEED in shown or WHEEL_TURN in shown  # then motion shows nothing
    if not changed and len(moved) > 1 and one_to_one and not shifted and (actions or not ends):
        changed = [_permuted(moved, task)]
    if changed:
        ends = {end: off for end, off in ends.items() if end not in actions}
    if any(one.cause == GOALS for one in of_rows) and POSE not in ends:
        ends.pop(PLAN, None)  # of another goal, not of another scale
    if any(one.cause in ("LIDAR_OFF", "LIDAR_SHORT") for one in of_rows):
        ends.pop(LIDAR, None)  # known better than by its scale
    follow = {check for end in (*ends, *shown) for check in TABLES.follow.get(end, ())}
    of_rows = [one for one in of_rows if one not in changed and not set(one.evidence) <= follow]
    found += changed + [_of_end(end, off, task) for end, off in ends.items()]
    if any(one.cause == COARSE for one in of_rows):
        found = [one for one in found if one.cause not in ("ACTIONS_MIXED", "COMMAND_SCALED")]
    return found + of_rows


def _of_signals(
    off: dict[str, Comparison], of_rows: Sequence[Finding], answers: Sequence[Answer]
) -> tuple[list[Finding], tuple[str, ...]]:
    """Return the findings of signals' own values, and which signals (ends) these explain."""
    if any(one.cause == "EPISODES_REPEATED" for one in of_rows):
        return [], ()  # every value comes again
    by_end: dict[str, list[tuple[str, Comparison]]] = {}
    for check, row in off.items():
        kind = next(one for one in OF_SIGNALS if check.startswith(one))
        by_end.setdefault(check.removeprefix(kind), []).append((kind, row))
    if POSE in by_end:
        by_end.pop(PLAN, None)  # seen from the pose
    shown, found = tuple(by_end), []
    if by_end.keys() >= set(GROUPS["wheels"]):
        by_end["wheels"] = by_end.pop(WHEEL_SPEED) + by_end.pop(WHEEL_TURN)
    for end, rows in by_end.items():
        kind, row = min(rows, key=lambda one: OF_SIGNALS.index(one[0]))
        ends = GROUPS.get(end, (end,))
        explained = (row for one in answers if _has(one, ends) for row in one.comparisons)
        evidence = (*(each.check for _, each in rows), *(row.check for row in explained if row.off))
        found.append(TABLES.ends[kind].finding(evidence, end=end, row=row, key=TABLES.keys[end]))
    return found, shown


def odd_ends(answers: Sequence[Answer]) -> dict[str, list[Answer]]:
    """Return the ends that faulty relations have in common, each with those relations."""
    left = [one for one in answers if one.off]
    fine = [one for one in answers if one.fine and one.relation.gain is not None]
    names = dict.fromkeys(end for one in left for end in (one.relation.x, one.relation.y))
    candidates = {name: (name,) for name in names} | GROUPS
    odd: dict[str, list[Answer]] = {}
    while left:
        worth = {
            name: (
                sum(_has(one, ends) for one in left),
                -sum(_has(one, ends) for one in fine),
                name not in GROUPS,
            )
            for name, ends in candidates.items()
        }
        best = max(worth, key=worth.__getitem__)
        odd[best] = [one for one in left if _has(one, candidates[best])]
        left = [one for one in left if one not in odd[best]]
    return odd


def _has(answer: Answer, ends: tuple[str, ...]) -> bool:
    return answer.relation.x in ends or answer.relation.y in ends


def _distortion(end: str, off: Sequence[Answer]) -> tuple[float, float]:
    """Return the factor by which an end's values are scaled, and how many steps late they are."""
    ends = GROUPS.get(end, (end,))
    scales, delays = [], []
    if any(one.is_off("delay") for one in off):  # no scale shows where a delay is not fitted
        off = [one for one in off if len(one.relation.lags) > 1]
    for one in off:
        is_answer = one.relation.y in ends
        if one.gain == one.gain and one.gain and one.is_off("gain"):
            scales.append(one.gain if is_answer else 1 / one.gain)
        if one.is_off("delay"):
            delays.append(one.delay if is_answer else -one.delay)
    return median(scales) if scales else 1.0, median(delays) if delays else 0.0


def _is_shift(scale: float, delay: float) -> bool:
    return 1 / GAIN <= scale <= GAIN and abs(delay) > DELAY_STEPS


def _of_end(end: str, off: Sequence[Answer], task: Task) -> Finding:
    scale, delay = _distortion(end, off)
    rows = [row for one in off for row in one.comparisons if row.off]
    named = {row.check.partition(":")[0]: row for row in reversed(rows)}  # the first of each figure
    is_action = end in (ACTION_SPEED, ACTION_TURN, "actions")
    surely, some, turn = _surely_reversed(off), named.get("missions"), named.get("turn")
    gain = 1 / scale if scale else math.inf
    units = ((scale, ""), (gain, "the inverse of "))
    unit = [f": {inverse}{name}?" for by, inverse in units for (low, high), name in _UNITS
            if low <= by <= high]  # fmt: skip
    degrees = math.degrees(math.atan(turn.effect or 0.0)) if turn else 0.0
    bias = named["offset"].effect or 0.0 if "offset" in named else 0.0
    part = _in_part(end, off)
    mixed = some is not None and (some.logs or 0.0) < _MOST
    if part and not surely and not (mixed and part[0] in ("opposite", "still", "unlike")):
        return _part_of(end, part, rows, task)
    if is_action and gain < 1 / GAIN:
        kind = "opposite" if surely and gain < -1 / GAIN else "weak"
    elif scale < 0 and surely:
        kind = "reversed"
    elif _is_shift(scale, delay):
        kind = "early" if is_action and delay < 0 else "shifted"
    elif mixed:
        kind = "mixed"
    elif scale > 0 and scale != 1:
        kind = "scaled"
    else:
        kind = "turned" if turn else "biased" if "offset" in named else "unlike"
    return TABLES.ends[kind].finding(
        tuple(row.check for row in rows), end=end, key=TABLES.keys[end], scale=scale, some=some,
        what="ACTIONS" if is_action else "SENSOR", scaled="COMMAND" if is_action else "SENSOR",
        way=TABLES.ways.get(end, TABLES.ways["actions"]), unit="".join(unit[:1]), gain=gain,
        part=max(gain, 0.0), share=(1 - (gain if surely else max(gain, 0.0))) / 2,
        others=min(1 - gain, 1.0), steps=abs(delay), late="late" if delay > 0 else "early",
        seconds=abs(delay) * task.control_period_s, degrees=abs(degrees),
        side="left" if degrees > 0 else "right", bias=abs(bias),
    )  # fmt: skip


def _in_part(end: str, off: Sequence[Answer]) -> tuple[str, float] | None:
    """Return what most of the relations show that an end does in some stretches only."""
    ends = GROUPS.get(end, (end,))
    shapes: list[tuple[str, float]] = []
    for one in sorted(off, key=lambda one: one.relation.y not in ends):
        if one.shape is not None:
            shape, by = one.shape
            if one.relation.y not in ends:
                if any(shape != "unlike" for shape, _ in shapes):
                    break  # it shows less: what is wrong is expected
                by = 1 / by if shape == "scaled" and by else -by
            if shape == "scaled" and by < _NONE:
                shape = "opposite" if by < _OPPOSITE else "still"
            shapes.append((shape, by))
    counts = Counter(shape for shape, _ in shapes if shape != "unlike")
    if not counts:
        return shapes[0] if shapes and not any(one.is_off("gain") for one in off) else None
    best = counts.most_common(1)[0][0]
    return best, median(by for shape, by in shapes if shape == best)


def _part_of(end: str, part: tuple[str, float], rows: Sequence[Comparison], task: Task) -> Finding:
    shape, by = part
    some = next(row for row in rows if row.check.startswith("stretches"))
    action = end in (ACTION_SPEED, ACTION_TURN, "actions")
    what = "ACTIONS" if action else "SENSOR"
    names = {"shifted": f"{what}_SHIFTED", "spikes": f"{what}_SPIKES", "biased": f"{what}_BIASED",
             "scaled": "COMMAND_SCALED" if action else "SENSOR_SCALED"}  # fmt: skip
    how = TABLES.shapes[shape].format(
        by=by, steps=abs(by), seconds=abs(by) * task.control_period_s,
        late="late" if by > 0 else "early",
    )  # fmt: skip
    return TABLES.ends["part"].finding(
        tuple(row.check for row in rows), end=end, key=TABLES.keys[end], some=some, how=how,
        name=names.get(shape, f"{what}_MIXED"),
    )  # fmt: skip


def _surely_reversed(off: Sequence[Answer]) -> bool:
    """Return whether each gain that is off is below 0 with its whole interval, unlike noise."""
    gains = [
        row for one in off for row in one.comparisons if row.off and row.check.startswith("gain")
    ]
    return bool(gains) and all(row.high is not None and row.high < 0 for row in gains)


def _permuted(moved: Sequence[tuple[Comparison, int, int]], task: Task) -> Finding:
    evidence = tuple(row.check for row, _, _ in moved)
    mirror = all(
        task.actions[other] == (task.actions[place][0], -task.actions[place][1])
        for _, place, other in moved
    )
    names = task.action_names
    pairs = "; ".join(f"{names[place]!r} is {names[other]!r}" for _, place, other in moved)
    return TABLES.ends["opposite" if mirror else "permuted"].finding(
        evidence, key=TABLES.keys[ACTION_TURN], way=TABLES.ways[ACTION_TURN], pairs=pairs
    )


def _of_rows(off: Sequence[Comparison]) -> list[Finding]:
    """Return findings of checks that imply their cause; the first one claims a check."""
    left = {row.check: row for row in off}
    found: list[Finding] = []
    for kind in TABLES.kinds:
        beside = not kind.beside or any(check in left for check in kind.beside)
        if kind.checks[0] in left and beside:
            used = tuple(check for check in kind.checks if check in left)
            by_name = {name.replace(" ", "_"): row for name, row in left.items()}
            found.append(kind.finding(used, **by_name))
            left = {name: row for name, row in left.items() if name not in used}
    for prefix, kind in TABLES.labels.items():
        if used := tuple(name for name in left if name.startswith(prefix)):
            each = (f"{name.removeprefix(prefix)} {left[name].logs:.0%}" for name in used)
            found.append(kind.finding(used, shares=", ".join(each)))
            left = {name: row for name, row in left.items() if name not in used}
    for name, row in left.items():
        kind = TABLES.ends["chosen" if name.startswith(CHOSEN) else "value"]
        note = f" ({row.note})" if row.note else ""
        found.append(kind.finding((name,), row=row, of=name.removeprefix(CHOSEN), note=note))
    return found


@dataclass(frozen=True)
class Kind:
    """A cause, as `causes.toml` has it."""

    cause: str
    text: str
    remedy: str
    checks: tuple[str, ...] = ()
    beside: tuple[str, ...] = ()

    def finding(self, evidence: tuple[str, ...], **known: Any) -> Finding:
        """Return the finding of this cause, its words filled in with what is `known`."""
        cause, text, remedy = (one.format(**known) for one in (self.cause, self.text, self.remedy))
        return Finding(cause, text, remedy, evidence)


@dataclass(frozen=True)
class _Tables:
    keys: dict[str, str]
    ways: dict[str, str]
    follow: dict[str, tuple[str, ...]]
    ends: dict[str, Kind]
    shapes: dict[str, str]
    labels: dict[str, Kind]
    kinds: tuple[Kind, ...]


TABLES = msgspec.toml.decode(
    (files("restock.train.judge") / "causes.toml").read_bytes(), type=_Tables
)
