"""Which policy of a run drives, and from which step of training it is.

It is the best by the run's evaluations. A run that stopped before it evaluated what it learned in
the twin has only evaluated the policy that it began with: then the latest drives, that of its last
checkpoint.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from safetensors import SafetensorError, safe_open

from restock.train.run.run import Run


@dataclass(frozen=True)
class PolicyOrigin:
    """The step of training that a policy is from, and why it is the one that drives."""

    chosen: Literal["best", "latest"]
    env_steps: int
    gradient_steps: int
    run_env_steps: int  # of the run so far; 0: it never drove

    @property
    def text(self) -> str:
        """The origin for people: `policy of step 120,000 of 192,000, the best in training`."""
        if not self.run_env_steps:
            return f"policy of update {self.gradient_steps:,}, from the logs alone"
        of = "" if self.env_steps == self.run_env_steps else f" of {self.run_env_steps:,}"
        best = self.chosen == "best"
        why = "the best in training" if best else "the latest; not evaluated in training"
        return f"policy of step {self.env_steps:,}{of}, {why}"

    @property
    def document(self) -> dict[str, Any]:
        """The fields and the text as JSON values."""
        return {**asdict(self), "text": self.text}


def kept_policy(run: Run) -> PolicyOrigin | None:
    """Return the policy that would drive now; None without checkpoint and evaluation."""
    chosen: Literal["best", "latest"] = "latest" if latest_drives(run) else "best"
    clocks = run_clocks(run) if chosen == "latest" else _values(run.best)
    if not clocks:
        best = [row for row in run.table("evaluations").to_pylist() if row["best"]]
        if not best:
            return None
        clocks = best[-1]
    return PolicyOrigin(chosen, clocks["env_steps"], clocks["gradient_steps"], env_steps_of(run))


def latest_drives(run: Run) -> bool:
    """Tell whether the run has learned, but never evaluated what it learned in the twin."""
    latest, best = _values(run.latest), _values(run.best)
    if not latest:
        return False
    progress = latest["progress"]
    evaluated_at = max(progress["evaluated_at"], best.get("env_steps", -1))
    if evaluated_at < 0:
        return bool(latest["learner"]["gradient_steps"])
    return bool(progress["online_updates"]) and evaluated_at <= progress["online_from"]


def run_clocks(run: Run) -> dict[str, Any]:
    """Return the last checkpoint's clocks: steps, updates and seconds; empty without one."""
    latest = _values(run.latest)
    if not latest:
        return {}
    progress = latest["progress"]
    return {
        "env_steps": progress["env_steps"],
        "gradient_steps": latest["learner"]["gradient_steps"],
        "wall_s": progress["wall_s"],
        "updated_online": progress["online_updates"] > 0,
    }


def env_steps_of(run: Run) -> int:
    """Environment steps of a run so far, by its last checkpoint and its tables."""
    steps: list[int] = [run_clocks(run).get("env_steps", 0)]
    for name in ("progress", "evaluations"):
        steps += run.table(name)["env_steps"].to_pylist()
    return max(steps)


def _values(path: Path) -> dict[str, Any]:
    """Numbers and texts of a checkpoint, without its arrays; empty if it cannot be read."""
    try:
        with safe_open(path, framework="numpy") as opened:
            values = json.loads((opened.metadata() or {})["state"])
    except (SafetensorError, OSError, ValueError, LookupError):
        return {}
    return values if isinstance(values, dict) else {}


__all__ = ["PolicyOrigin", "env_steps_of", "kept_policy", "latest_drives", "run_clocks"]
