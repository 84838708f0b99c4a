"""Infer what is wrong with logs from the comparisons that are off, in words for their owner.

A sensor whose readings are scaled, reversed or late breaks every relation that uses it, while the
other sensors agree with each other. So the fault is in the smallest set of signals that the broken
relations have in common. The signals x and y of a relation are called its ends.
"""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from statistics import median
from typing import Any

import msgspec

from restock.ingest.task.task import Task
from restock.train.judge.answers import (
    ACTION,
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
from restock.train.judge.beside import COPIED, HELD, LIMIT, PROPOSED, ROUNDED, ZEROS
from restock.train.judge.fed_rows import Comparison
from restock.train.judge.mission_checks import CHOSEN

GROUPS = {"actions": (ACTION_SPEED, ACTION_TURN), "wheels": (WHEEL_SPEED, WHEEL_TURN)}
GOALS = "GOALS_OF_OTHERS"
_FIRST = (  # if one of these causes is found, other checks mean nothing
    *("ROWS_APART", "ROWS_UNCHANGED", "FUTURE_IN_OBSERVATION"),
)
# Checks of a signal's values. If several are off, the first explains the others.
OF_SIGNALS = (LIMIT, ZEROS, ROUNDED, COPIED, HELD)
_PARTIAL = ("shifted", "scaled", "biased", "spikes")  # causes of broken stretches; first wins ties
_UNDONE = {"opposite": "scaled", "reversed": "scaled"}  # kind of fault -> name in `Broken.mended`
_ZEROS = {"turn": "turned", "arm": "off centre", "offset": "biased"}  # figure -> fault if not 0
_OPPOSITE, _STILL = -0.6, 0.3  # signals with scales below these are reversed, or stand still
MENDED = 0.8  # a cause counts if at least this share of broken stretches holds once it is undone
CHANGED = "ACTIONS_CHANGED"  # if found, the profile is not to blame for any fault of the actions
COARSE = "ACTIONS_COARSE"  # if found, actions explain less of the motion even if all else is right
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

    cause: str  # name of the cause in docs and JSON
    text: str  # what is wrong, and by how much
    remedy: str
    evidence: tuple[str, ...]  # the `check` of each comparison that shows it


def findings(answers: Sequence[Answer], others: Iterable[Comparison], task: Task) -> list[Finding]:
    """Return the faults that the checks show, the least understood last."""
    of_signals: dict[str, Comparison] = {}  # by `check`
    moved: list[Comparison] = []
    rest: list[Comparison] = []
    for row in others:
        if row.off and row.check.startswith(OF_SIGNALS):
            of_signals[row.check] = row
        elif row.off:
            (moved if row.check.startswith(ACTION) else rest).append(row)
    of_rows = _row_findings(rest)
    first = [one for one in of_rows if one.cause in _FIRST]
    if first:  # all else that is off may follow from these
        return first + [one for one in of_rows if one.cause in _ON_THEIR_OWN]
    found, shown = _signal_findings(of_signals, of_rows, answers)
    ends = odd_ends([one for one in answers if not _uses_end(one, shown)])
    one_to_one = len({row.note for row in moved}) == len(moved)
    actions = [end for end in ends if end in (ACTION_SPEED, ACTION_TURN, "actions")]
    # Late or early actions look permuted, too. So do actions if the wheel signals are wrong.
    shifted = any(_is_shift(*_distortion(end, ends[end])) for end in actions)
    changed = [one for one in of_rows if one.cause == CHANGED]
    shifted |= WHEEL_SPEED in shown or WHEEL_TURN in shown
    if not changed and len(moved) > 1 and one_to_one and not shifted and (actions or not ends):
        changed = [_permutation(moved, task)]
    if changed:
        ends = {end: off for end, off in ends.items() if end not in actions}
    if any(one.cause == GOALS for one in of_rows) and POSE not in ends:
        ends.pop(PLAN, None)  # a wrong goal explains the plan's scale
    if any(one.cause in ("LIDAR_OFF", "LIDAR_SHORT", "LIDAR_BLIND") for one in of_rows):
        ends.pop(LIDAR, None)  # these causes explain the lidar's relations
    follow = {check for end in (*ends, *shown) for check in TABLES.follow.get(end, ())}
    of_rows = [one for one in of_rows if one not in changed and not set(one.evidence) <= follow]
    found += changed + [_explain_end(end, off, task) for end, off in ends.items()]
    if any(one.cause == COARSE for one in of_rows):
        found = [one for one in found if one.cause not in ("ACTIONS_MIXED", "COMMAND_SCALED")]
    return found + of_rows


def _signal_findings(
    off: dict[str, Comparison], of_rows: Sequence[Finding], answers: Sequence[Answer]
) -> tuple[list[Finding], tuple[str, ...]]:
    """Return the findings from signals' own values, and the signals that these explain."""
    causes = {one.cause for one in of_rows}
    if "EPISODES_REPEATED" in causes:
        return [], ()  # repeated episodes explain odd values of any signal
    if "LIDAR_OFF" in causes:
        off.pop(ZEROS + LIDAR, None)  # ranges that are too short become 0 near things
    by_end: dict[str, list[tuple[str, Comparison]]] = {}
    for check, row in off.items():
        kind = next(one for one in OF_SIGNALS if check.startswith(one))
        end = check.removeprefix(kind)
        if _repairs_relations(check, [one for one in answers if _uses_end(one, (end,))]):
            by_end.setdefault(end, []).append((kind, row))
    if POSE in by_end or POSE in odd_ends(answers):
        by_end.pop(PLAN, None)  # the plan is measured from the pose, so a wrong pose explains it
    shown, found = tuple(by_end), []
    if by_end.keys() >= set(GROUPS["wheels"]):
        by_end["wheels"] = by_end.pop(WHEEL_SPEED) + by_end.pop(WHEEL_TURN)
    for end, rows in by_end.items():
        kind, row = min(rows, key=lambda one: OF_SIGNALS.index(one[0]))
        ends = GROUPS.get(end, (end,))
        explained = (row for one in answers if _uses_end(one, ends) for row in one.comparisons)
        evidence = (*(each.check for _, each in rows), *(row.check for row in explained if row.off))
        found.append(TABLES.ends[kind].finding(evidence, end=end, row=row, key=TABLES.keys[end]))
    return found, shown


def _repairs_relations(check: str, answers: Sequence[Answer]) -> bool:
    """Return whether broken relations mostly hold without the odd values that a check found.

    Also true if no relation can test this, and for copied or rounded values, which need no test.
    """
    broken = [one.broken.mended for one in answers if one.broken]
    shares = [mended[check][0] for mended in broken if check in mended]
    return not shares or median(shares) >= MENDED or check.startswith((COPIED, ROUNDED))


def odd_ends(answers: Sequence[Answer]) -> dict[str, list[Answer]]:
    """Return a small set of ends (signals) that explains all faulty relations: end -> relations."""
    left = [one for one in answers if one.off]
    fine = [one for one in answers if one.fine and one.relation.defined]
    names = dict.fromkeys(end for one in left for end in (one.relation.x, one.relation.y))
    candidates = {name: (name,) for name in names} | GROUPS
    odd: dict[str, list[Answer]] = {}
    while left:
        worth = {
            name: (
                sum(_uses_end(one, ends) for one in left),
                -sum(_uses_end(one, ends) for one in fine),
                name not in GROUPS,
            )
            for name, ends in candidates.items()
        }
        best = max(worth, key=worth.__getitem__)
        odd[best] = [one for one in left if _uses_end(one, candidates[best])]
        left = [one for one in left if one not in odd[best]]
    return odd


def _uses_end(answer: Answer, ends: tuple[str, ...]) -> bool:
    return answer.relation.x in ends or answer.relation.y in ends


def _distortion(end: str, off: Sequence[Answer]) -> tuple[float, float]:
    """Return the factor by which an end's values are scaled, and how many steps late they are."""
    ends = GROUPS.get(end, (end,))
    scales, delays = [], []
    if any(one.is_off("delay") for one in off):  # one lag cannot tell a delay from a scale
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


def _explain_end(end: str, off: Sequence[Answer], task: Task) -> Finding:
    """Return the fault that, once undone, makes an end's relations hold; else describe them."""
    rows = [row for one in off for row in one.comparisons if row.off]
    named = {row.check.partition(":")[0]: row for row in reversed(rows)}  # figure -> its first row
    is_action = end in (ACTION_SPEED, ACTION_TURN, "actions")
    scale, steps, bias = (*_distortion(end, off), 0.0)
    kind, some, mended, in_part = "", named.get("stretches"), _shares_mended(end, off), ""
    if all(one.holds for one in off):
        bias = named["offset"].effect or 0.0 if "offset" in named else 0.0
        kind = _constant_fault(end, scale, steps, off, named)
        if mended and mended.get(_UNDONE.get(kind, kind), (1.0, 0.0))[0] < MENDED:
            kind = ""
    if not kind and mended:
        best = max(mended, key=lambda cause: mended[cause][0])
        share, by = mended[best]
        if share >= MENDED:
            scale, steps, bias = (by * (best == one) for one in ("scaled", "shifted", "biased"))
            kind, in_part = best, TABLES.in_part.format(some=some)
            if best == "scaled" and by < _STILL:
                kind = "reversed" if by < _OPPOSITE else "still"
    gain = 1 / scale if scale else math.inf
    units = ((scale, ""), (gain, "the inverse of "))
    unit = [f": {inverse}{name}?" for by, inverse in units for (low, high), name in _UNITS
            if low <= by <= high]  # fmt: skip
    turn, arm = (row.effect or 0.0 if (row := named.get(one)) else 0.0 for one in ("turn", "arm"))
    degrees = math.degrees(math.atan(turn))
    found = TABLES.ends[kind or "unlike"].finding(
        tuple(row.check for row in rows), end=end, key=TABLES.keys[end], scale=scale,
        what="ACTIONS" if is_action else "SENSOR", scaled="COMMAND" if is_action else "SENSOR",
        way=TABLES.ways.get(end, TABLES.ways["actions"]), unit="".join(unit[:1]), gain=gain,
        steps=round(abs(steps), 1), late="late" if steps > 0 else "early",
        mirrored="MIXED" if in_part else "MIRRORED",
        seconds=abs(steps) * task.control_period_s, degrees=abs(degrees),
        side="left" if degrees > 0 else "right", arm=arm, bias=bias, rate=off[0].relation.unit,
        unlike="ACTIONS_MIXED" if is_action else "SENSOR_MIXED" if some else "UNLIKE_TWIN",
        does="do" if end in GROUPS else "does", how=_describe_mismatch(end, off, named),
    )  # fmt: skip
    return replace(found, text=in_part + found.text)


def _constant_fault(
    end: str, scale: float, steps: float, off: Sequence[Answer], named: Container[str]
) -> str:
    """Return the kind of a fault that is the same in all rows; "" if it is not clear."""
    is_action = end in (ACTION_SPEED, ACTION_TURN, "actions")
    if scale < 0:
        kind = "opposite" if is_action else "reversed"
        return kind if _surely_reversed(off) else ""
    if _is_shift(scale, steps):
        return "shifted"
    if scale != 1:  # a scale cannot explain an offset, and a lidar's scale cancels in its relations
        return "scaled" if "offset" not in named and end != LIDAR else ""
    return next((kind for figure, kind in _ZEROS.items() if figure in named), "")


def _shares_mended(end: str, off: Sequence[Answer]) -> dict[str, tuple[float, float]]:
    """Return, by cause, the share of broken stretches that hold once it is undone, and its size.

    Both are medians over the end's relations. Empty if no relation has too many broken stretches.
    """
    ends = GROUPS.get(end, (end,))
    found: dict[str, list[tuple[float, float]]] = {}
    for one in off:
        if one.broken is None or not one.is_off("stretches"):
            continue
        for cause in _PARTIAL:
            share, by = one.broken.mended.get(cause, (0.0, 1.0))
            if one.relation.y not in ends:  # the end is x: its fault is the inverse
                by = 1 / by if cause == "scaled" and by else -by
            found.setdefault(cause, []).append((share, by))
    return {
        cause: (
            median(share for share, _ in each),
            median([by for share, by in each if share >= MENDED] or [0.0]),
        )
        for cause, each in found.items()
    }


def _describe_mismatch(end: str, off: Sequence[Answer], named: Mapping[str, Comparison]) -> str:
    """Describe which signals an end does not follow, in how much of the drive, and by how much."""
    ends = GROUPS.get(end, (end,))
    signals = dict.fromkeys(one for each in off for one in (each.relation.x, each.relation.y))
    *others, last = [one for one in signals if one not in ends] or ["where it heads"]
    followed = " and ".join([", ".join(others), last] if others else [last])
    figure = next(one for one in TABLES.how if one in named or one == "gain")
    one = next((one for one in off if one.is_off(figure)), off[0])
    rows = {row.check.partition(":")[0]: row for row in one.comparisons}
    return TABLES.how[figure].format(
        others=followed, row=rows.get(figure), left=rows.get("unexplained"), broken=one.broken,
        unit=one.relation.unit,
    )  # fmt: skip


def _surely_reversed(off: Sequence[Answer]) -> bool:
    """Return whether all gains that are off are surely negative, and not just by chance."""
    gains = [
        row for one in off for row in one.comparisons if row.off and row.check.startswith("gain")
    ]
    return bool(gains) and all(row.high is not None and row.high < 0 for row in gains)


def _permutation(moved: Sequence[Comparison], task: Task) -> Finding:
    motion = dict(zip(task.action_names, task.actions, strict=True))
    names = [(row.check.removeprefix(ACTION), row.note) for row in moved]
    mirror = all(motion[of] == (motion[name][0], -motion[name][1]) for name, of in names)
    pairs = "; ".join(f"{name!r} is {of!r}" for name, of in names)
    return TABLES.ends["opposite" if mirror else "permuted"].finding(
        tuple(row.check for row in moved),
        key=TABLES.keys[ACTION_TURN],
        way=TABLES.ways[ACTION_TURN],
        pairs=pairs,
    )


def _row_findings(off: Sequence[Comparison]) -> list[Finding]:
    """Return the findings of checks that imply their cause; a check counts for one finding only."""
    left = {row.check: row for row in off}
    if "driver" in left:  # a wrong driver also explains an odd share of proposals among actions
        left = {name: row for name, row in left.items() if not name.startswith(PROPOSED)}
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
        prefix = next((one for one in (CHOSEN, PROPOSED) if name.startswith(one)), "")
        kind = TABLES.ends[prefix or "value"]
        note = f" ({row.note})" if row.note else ""
        found.append(kind.finding((name,), row=row, of=name.removeprefix(prefix), note=note))
    return found


@dataclass(frozen=True)
class Kind:
    """A cause, as defined in `causes.toml`."""

    cause: str
    text: str
    remedy: str
    checks: tuple[str, ...] = ()
    beside: tuple[str, ...] = ()

    def finding(self, evidence: tuple[str, ...], **known: Any) -> Finding:
        """Return the finding of this cause, with its texts filled in from `known`."""
        cause, text, remedy = (one.format(**known) for one in (self.cause, self.text, self.remedy))
        return Finding(cause, text, remedy, evidence)


@dataclass(frozen=True)
class _Tables:
    in_part: str
    keys: dict[str, str]
    ways: dict[str, str]
    follow: dict[str, tuple[str, ...]]
    ends: dict[str, Kind]
    how: dict[str, str]
    labels: dict[str, Kind]
    kinds: tuple[Kind, ...]


TABLES = msgspec.toml.decode(
    (files("restock.train.judge") / "causes.toml").read_bytes(), type=_Tables
)
