"""What is told of a moment's steps, in words and numbers, whatever shows it."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from restock.replay.trace.moment import Moment
from restock.train.view.critic import Critic

if TYPE_CHECKING:  # it needs the twin and its physics
    from restock.train.view.evaluated import Evaluated


def texts_of(moment: Moment, critic: Critic | None, index: int) -> dict[str, str]:
    """What is said of a step in words: labels, driver, action."""
    step, names = moment.steps[index], moment.task.action_names
    texts = {
        "condition": step["condition"],
        "conditions": _conditions(step["conditions"]),
        "true_condition": step["true_condition"],
        "behaviour_policy": step["behaviour_policy"],
        "action": names[step["action"]],
    }
    if critic is not None:
        texts["critic/greedy_action"] = names[int(critic.greedy[index])]
    return {name: text for name, text in texts.items() if text}


def _conditions(names: list[str] | None) -> str:
    """All that a step is labelled as; nothing where nobody labelled it."""
    return "" if names is None else ", ".join(names) or "nominal"


def numbers_of(moment: Moment, critic: Critic | None, index: int) -> dict[str, float]:
    """What is plotted of a step, as far as the store has it."""
    step = moment.steps[index]
    names = {
        "reward": "reward",
        "speed/command_mps": "command_speed_mps",
        "speed/wheels_mps": "wheel_speed_mps",
        "speed/localised_mps": "localised_speed_mps",
        "turn/command_radps": "command_yaw_rate_radps",
        "turn/gyro_radps": "gyro_yaw_rate_radps",
        "clearance/least_m": "clearance_m",
        "clearance/ahead_m": "clearance_ahead_m",
    }
    numbers = {
        name: float(step[column]) for name, column in names.items() if step[column] is not None
    }
    if critic is not None:
        numbers["critic/value"] = float(critic.value[index])
        numbers["critic/best_value"] = float(critic.best[index])
        numbers["critic/td_error"] = float(critic.td[index])
    return numbers


def about(moment: Moment, critic: Critic | None) -> str:
    """Which transition the moment is about, as JSON."""
    keys = ("transition_id", "episode_id", "step_index", "stamp_ns", "condition", "zone")
    reported = {key: moment.at[key] for key in (*keys, "behaviour_policy", "reward", "source_file")}
    if critic is not None:
        reported["critic"] = f"{critic.run}: {critic.weights}"
    return json.dumps(reported)


def about_evaluated(evaluated: Evaluated, critic: Critic | None) -> str:
    """Which episode of an evaluation it is, and how it went, as JSON."""
    keys = ("condition", "block", "episode_seed", "layout", "version", "success", "failure")
    reported = {key: evaluated.outcome[key] for key in (*keys, "bumps", "time_s", "return")}
    if critic is not None:
        reported["critic"] = f"{critic.run}: {critic.weights}"
    return json.dumps(reported)
