"""Infer what is wrong with logs from the comparisons that are off, in their owner's words.

A sensor whose readings are scaled, turned round or late is off in every relation that it takes part
in, and the others agree among themselves. So the smallest set of ends that all failing relations
share is at fault.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import median

from restock.ingest.task.task import Task
from restock.train.judge.answers import (
    ACCELEROMETER,
    ACTION_SPEED,
    ACTION_TURN,
    DELAY_STEPS,
    GAIN,
    GYROSCOPE,
    LIDAR,
    PLAN,
    POSE,
    WHEEL_SPEED,
    WHEEL_TURN,
    Answer,
)
from restock.train.judge.fed_rows import Comparison
from restock.train.judge.mission_checks import CHOSEN

GROUPS = {"actions": (ACTION_SPEED, ACTION_TURN), "wheels": (WHEEL_SPEED, WHEEL_TURN)}
_KEYS = {  # where a profile says what fills it
    ACTION_SPEED: "[inputs.command] fields.speed_mps",
    ACTION_TURN: "[inputs.command] fields.yaw_rate_radps",
    "actions": "[inputs.command]",
    WHEEL_SPEED: "[inputs.wheels] fields.speed_mps",
    WHEEL_TURN: "[inputs.wheels] fields.yaw_rate_radps",
    "wheels": "[inputs.wheels]",
    GYROSCOPE: "[inputs.imu] fields.yaw_rate_radps",
    POSE: "[inputs.pose]",
    PLAN: "[inputs.plan]",
    LIDAR: "[inputs.scan]",
    ACCELEROMETER: "[inputs.imu] fields.accel_x_mps2",
}
VALUES = "VALUES_UNLIKE_TWIN"
_ARRIVAL = ("terminated at the goal", "goal reward")
GOALS = "GOALS_OF_OTHERS"
FOLLOW_FROM = {  # checks that are off because an end is
    GYROSCOPE: ("range: gyro_yaw_rate", "spread: gyro_yaw_rate", "lidar scale"),
    **dict.fromkeys(
        (WHEEL_SPEED, "wheels"),
        ("range: wheel_speed", "spread: wheel_speed", "range: accel_x", "spread: accel_x"),
    ),
    POSE: (
        *("range: localised_speed", "spread: localised_speed", "range: lateral_speed"),
        *("spread: lateral_speed", "range: goal_distance", "spread: goal_distance", *_ARRIVAL),
        *("lidar scale", "goals come nearer", "floor"),
    ),
    PLAN: ("range: goal_distance", "spread: goal_distance", *_ARRIVAL),
    ACCELEROMETER: ("range: accel_x", "spread: accel_x"),
    LIDAR: ("range: clearances", "spread: clearances"),
}
_FIRST = (  # nothing can be told of rows before these
    *("ROWS_APART", "ROWS_UNCHANGED", "FUTURE_IN_OBSERVATION"),
)
CHANGED = "ACTIONS_CHANGED"  # then nothing that actions show is the profile's fault
COARSE = "ACTIONS_COARSE"  # then actions explain less of the motion, whatever else is right
_LABELS = {  # by how the name of their checks, one a condition, begins
    "fed labels: ": (
        "LABELS_CHANGED",
        "labels in the panel differ from those of its store: wrong in",
        "something changed labels after mixing: make the panel again with `restock mix`",
    ),
    "labels: ": (
        "LABELS_WRONG",
        "labels differ from what their conditions give on the stored signals: wrong in",
        "`restock store label STORE` computes them again; corrections by people are kept",
    ),
}
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
    of_rows = _of_rows([row for row in others if row.off])
    first = [one for one in of_rows if one.cause in _FIRST]
    if first:  # what rows are made of, and all that is compared with their next, follows from it
        return first + [one for one in of_rows if one.cause in _ON_THEIR_OWN]
    ends = odd_ends(answers)
    moved = [(row, place, other) for place, (row, other) in enumerate(permuted) if other != place]
    one_to_one = len({other for _, _, other in moved}) == len(moved)
    actions = [end for end in ends if end in (ACTION_SPEED, ACTION_TURN, "actions")]
    # Actions that are late or early are found in place of others, too.
    shifted = any(_is_shift(*_distortion(end, ends[end])) for end in actions)
    found = [one for one in of_rows if one.cause == CHANGED]
    if not found and len(moved) > 1 and one_to_one and not shifted and (actions or not ends):
        found = [_permuted(moved, task)]
    if found:
        ends = {end: off for end, off in ends.items() if end not in actions}
    if any(one.cause == GOALS for one in of_rows) and POSE not in ends:
        ends.pop(PLAN, None)  # of another goal, not of another scale
    follow = {check for end in ends for check in FOLLOW_FROM.get(end, ())}
    of_rows = [one for one in of_rows if one not in found and not set(one.evidence) <= follow]
    found += [_of_end(end, off, task) for end, off in ends.items()]
    if any(one.cause == COARSE for one in of_rows):
        found = [one for one in found if one.cause not in ("ACTIONS_MIXED", "COMMAND_SCALED")]
    return found + of_rows


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
    evidence = tuple(row.check for one in off for row in one.comparisons if row.off)
    seconds = abs(delay) * task.control_period_s
    is_action = end in (ACTION_SPEED, ACTION_TURN, "actions")
    key = _KEYS[end]
    gain = 1 / scale if scale else float("inf")
    if is_action and gain < 1 / GAIN:
        surely = _surely_reversed(off)
        if surely and gain < -1 / GAIN:
            return _mirrored(end, evidence)
        share = (1 - (gain if surely else max(gain, 0))) / 2
        return Finding(
            "ACTIONS_MIXED",
            f"only {max(gain, 0):.0%} of the expected motion follows from the logs' {end}, as if "
            f"{share:.0%} of the rows had the opposite sign, or {min(1 - gain, 1):.0%} belonged to "
            "other rows",
            f"check some recordings one by one: {key} may be right in some and wrong in others "
            "(robots, firmware), or actions may belong to other rows",
            evidence,
        )
    if scale < 0 and _surely_reversed(off):
        return Finding(
            "SENSOR_MIRRORED",
            f"the sign of the logs' {end} is opposite ({scale:+.2f} of the other signals)",
            f"change the sign of {key} in the profile (or its frame of reference)",
            evidence,
        )
    if scale > 0 and scale != 1 and not _is_shift(scale, delay):
        unit = next((name for (low, high), name in _UNITS if low <= scale <= high), "")
        unit = unit or next(
            (f"the inverse of {name}" for (low, high), name in _UNITS if low <= 1 / scale <= high),
            "",
        )
        return Finding(
            "SENSOR_SCALED" if not is_action else "COMMAND_SCALED",
            f"the scale of the logs' {end} is {scale:.3g} times that of the other signals"
            + (f": {unit}?" if unit else ""),
            f"scale {key} in the profile by {1 / scale:.3g}, or calibrate the sensor",
            evidence,
        )
    if _is_shift(scale, delay):
        late = delay > 0
        slower = (
            ""
            if late or not is_action
            else " (a robot with a much longer latency than the twin looks the same: `restock "
            "twin fit` estimates its latency)"
        )
        return Finding(
            "ACTIONS_SHIFTED" if is_action else "SENSOR_SHIFTED",
            f"the time of the logs' {end} is {seconds:.2g} s ({abs(delay):.1f} steps) "
            f"{'late' if late else 'early'} compared with the other signals{slower}",
            f"check the stamps of {key}: `restock info --clocks` shows each topic's clock; use "
            "the time of measurement, or correct the offset",
            evidence,
        )
    if biases := [row for one in off for row in one.comparisons
                  if row.off and row.check.startswith("offset")]:  # fmt: skip
        return Finding(
            "SENSOR_BIASED",
            f"the logs' {end} differs by {abs(biases[0].effect or 0.0):.2g} rad/s from the other"
            " signals also where these show no turn: a bias",
            f"calibrate the sensor, or correct the zero of {key}",
            evidence,
        )
    if some := [row for one in off for row in one.comparisons
                if row.off and row.check.startswith("missions")]:  # fmt: skip
        return Finding(
            "ACTIONS_MIXED" if is_action else "SENSOR_MIXED",
            f"in {some[0].logs:.0%} of the missions the logs' {end} does not follow the other"
            f" signals ({some[0].twin:.0%} in the twin): its sign is opposite there, or it stands"
            " still, or belongs to other rows",
            f"check missions one by one: {key} may be right in some and wrong in others",
            evidence,
        )
    return Finding(
        "UNLIKE_TWIN",
        f"the relation of the logs' {end} to the other signals is not that of the twin",
        f"check {key} for values of other rows, outliers or heavy noise",
        evidence,
    )


def _surely_reversed(off: Sequence[Answer]) -> bool:
    """Return whether each gain that is off is below 0 with its whole interval, unlike noise."""
    gains = [
        row for one in off for row in one.comparisons if row.off and row.check.startswith("gain")
    ]
    return bool(gains) and all(row.high is not None and row.high < 0 for row in gains)


def _mirrored(end: str, evidence: tuple[str, ...]) -> Finding:
    what = {
        ACTION_TURN: "the logs' left is the twin's right",
        ACTION_SPEED: "the logs' forward is the twin's backward",
    }.get(end, "the logs' actions are the opposite of the twin's")
    return Finding(
        "ACTIONS_MIRRORED",
        what,
        f"swap the sign of {_KEYS[end]} in the profile, and ingest the logs again",
        evidence,
    )


def _permuted(moved: Sequence[tuple[Comparison, int, int]], task: Task) -> Finding:
    evidence = tuple(row.check for row, _, _ in moved)
    mirror = all(
        task.actions[other] == (task.actions[place][0], -task.actions[place][1])
        for _, place, other in moved
    )
    if mirror:
        return _mirrored(ACTION_TURN, evidence)
    names = task.action_names
    pairs = "; ".join(f"{names[place]!r} is {names[other]!r}" for _, place, other in moved)
    return Finding(
        "ACTIONS_PERMUTED",
        f"the logs' actions are other actions of the twin: {pairs}",
        "the logs were made with another table of actions, or other units: use the [task] actions "
        "of their robot, check [inputs.command], and ingest them again",
        evidence,
    )


def _of_rows(off: Sequence[Comparison]) -> list[Finding]:
    """Return findings of checks that imply their cause; the first one claims a check."""
    left = {row.check: row for row in off}
    found: list[Finding] = []
    for kind in KINDS:
        beside = not kind.beside or any(check in left for check in kind.beside)
        if kind.checks[0] in left and beside:
            used = tuple(check for check in kind.checks if check in left)
            text = kind.text.format(**{name.replace(" ", "_"): row for name, row in left.items()})
            found.append(Finding(kind.cause, text, kind.remedy, used))
            for check in used:
                del left[check]
    for prefix, (cause, text, remedy) in _LABELS.items():
        if used := tuple(name for name in left if name.startswith(prefix)):
            shares = ", ".join(
                f"{name.removeprefix(prefix)} {left[name].logs:.0%}" for name in used
            )
            found.append(Finding(cause, f"{text} {shares}", remedy, used))
            left = {name: row for name, row in left.items() if name not in used}
    for name in [one for one in left if one.startswith(CHOSEN)]:
        row, condition = left.pop(name), name.removeprefix(CHOSEN)
        found.append(
            Finding(
                "CHOSEN_ON_OUTCOME",
                f"{condition} comes from failures: {row.twin:.0%} of its missions succeed, and"
                f" {row.logs:.0%} of the others that met the same situations: missions that handled"
                " it well are missing, or not called so",
                f"keep missions with {condition} that went well, or draw by situation:"
                ' [each_condition] kind = "exposure" in the mixture',
                (name,),
            )
        )
    found += [
        Finding(
            VALUES,
            f"{row.what}: {row.logs:.3g} in the logs" + (f" ({row.note})" if row.note else ""),
            "check the unit and the source of this value in the profile",
            (name,),
        )
        for name, row in left.items()
    ]
    return found


@dataclass(frozen=True)
class Kind:
    """A cause that checks of rows imply. `text` has each check's comparison by its name."""

    cause: str
    checks: tuple[str, ...]  # the first must be off; the others belong to it
    text: str
    remedy: str
    beside: tuple[str, ...] = ()  # one of these must be off too


KINDS = (
    Kind(
        "FUTURE_IN_OBSERVATION",
        ("foresight", "chain", "unchanged", "previous action", "own action", "closing"),
        "in {foresight.logs:.0%} of the rows where the action changes, the observation already "
        "contains the new action: observations are from one step later",
        "observations must contain only what was known before acting: ingest the logs again",
        beside=("chain", "unchanged"),
    ),
    Kind(
        "ROWS_APART",
        ("chain", "unchanged", "closing", "previous action", "own action"),
        "in {chain.logs:.0%} of the rows the next observation is not the observation of the next "
        "row: next observations are stale, or belong to other rows",
        "ingest the logs again; look for software that rewrites rows after ingest",
    ),
    Kind(
        "ROWS_UNCHANGED",
        ("unchanged", "closing"),
        "in {unchanged.logs:.0%} of the rows in which the robot moves the next observation is the"
        " observation itself",
        "topics may be slower than the control clock: use a longer control_period_s, or record "
        "them faster",
    ),
    Kind(
        "REWARD_DIFFERENT",
        ("reward rows", "goal reward", "reward scale"),
        "{reward_rows.logs:.0%} of the logs' rewards differ from the task's rewards for their "
        "rows: they may belong to other rows, or to another definition",
        "ingest the logs again with this profile",
    ),
    Kind(
        "REWARD_SCALED",
        ("reward scale", "goal reward"),
        "the logs' rewards are {reward_scale.effect:.3g} times the task's rewards for their rows",
        "ingest the logs again with this profile, and scale rewards nowhere else",
    ),
    Kind(
        "REWARD_DIFFERENT",
        ("goal reward",),
        "reaching the goal earns {goal_reward.logs:.3g} in the logs and {goal_reward.twin:.3g} in "
        "the twin",
        "ingest the logs again with this profile",
    ),
    Kind(
        "TERMINATIONS_LOST",
        ("terminated at the goal", "terminations"),
        "{terminated_at_the_goal.logs:.0%} of the logs' episodes that end at their goal are "
        "terminated there: in the others the critic bootstraps beyond the end",
        "check that the profile's [task] has the robot's goal radius, and ingest the logs again",
    ),
    Kind(
        "TERMINATIONS_WRONG",
        ("goes on after its end",),
        "{goes_on_after_its_end.logs:.0%} of the terminated rows are not the last of their episode",
        "terminations belong to other rows, or episodes were joined: ingest the logs again",
    ),
    Kind(
        CHANGED,
        ("own action", "previous action", "foresight"),
        "in {own_action.logs:.0%} of the rows the next observation does not contain the row's own "
        "action: the `action` column does not match the observations",
        "something changed actions after ingest: ingest the logs again, and mix the panel again",
    ),
    Kind(
        COARSE,
        ("far commands",),
        "{far_commands.logs:.0%} of the commands are more than .25 (of the fastest action) from "
        "the action that represents them",
        "give [task] actions that are nearer to the robot's commands, or check the unit of "
        "[inputs.command]; the audit `far_actions` lists the rows",
    ),
    Kind(
        "LIDAR_TURNED",
        ("lidar bearing",),
        "the logs' lidar is rotated by {lidar_bearing.effect:+.0f} degrees against the twin's: "
        "what comes nearer when driving forward is not ahead",
        "check the lidar's mounting: [task.body] lidar_yaw_rad, the scan's frame, [inputs.scan]",
    ),
    Kind(
        "LIDAR_SCALED",
        ("lidar scale",),
        "the scale of the logs' lidar is {lidar_scale.effect:.2g} times the twin's: things ahead "
        "come nearer by this factor for each metre driven",
        "check the unit and the range of [inputs.scan], and [task] range_max_m",
    ),
    Kind(
        "TERMINATIONS_WRONG",
        ("terminations",),
        "{terminations.logs:.0%} of the logs' terminations do not agree with their signals",
        "ingest the logs again with this profile",
    ),
    Kind(
        GOALS,
        ("goals come nearer",),
        "in {goals_come_nearer.logs:.0%} of the missions the robot drives and its goal comes no "
        "nearer ({goals_come_nearer.twin:.0%} in the twin): these goals and plans belong to other "
        "missions",
        "check which goal is in force when a mission begins: the stamps and the order of "
        "[inputs.goal] and [inputs.plan]",
    ),
    Kind(
        "FLOOR_MOVED",
        ("floor",),
        "the lidar sees racks {floor.note}",
        "correct the origin of the map or of the layout (`map_origin`), or make the floor from "
        "these logs: `restock twin layout --from STORE --out FLOOR.toml`, and set env.layouts",
    ),
    Kind(
        "EPISODES_REPEATED",
        ("repeated episodes",),
        "{repeated_episodes.logs:.0%} of the rows belong to episodes that are stored twice",
        "`restock audit` lists the recordings (repeated_steps): remove one of them with `restock "
        "store remove STORE RECORDING`",
    ),
)
