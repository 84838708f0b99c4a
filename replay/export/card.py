"""The card of a data set (`README.md`), with the metadata that a hub of data sets asks for.

Counted, not claimed: what is in it, who drove and in which conditions, what was left out, and what
its labels are worth. Paths of this machine are not in it; they are in the provenance.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator

from restock.errors import StoreError
from restock.replay.export.selection import Selection
from restock.replay.export.trajectory import Counts, Trajectory

READ = {
    "lerobot": 'LeRobotDataset("restock/logs", root=FOLDER)',
    "minari": "minari.MinariDataset(FOLDER)",
}
_HUB_TAG = {"lerobot": "LeRobot", "minari": "minari"}
_SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"))
_IDENTIFIER = re.compile(r"[a-z0-9][a-z0-9.-]*")


class Contents:
    """Counts what is written, as it goes by."""

    def __init__(self) -> None:
        self.conditions, self.policies = Counter[str](), Counter[str]()

    def counted(self, trajectories: Iterator[Trajectory]) -> Iterator[Trajectory]:
        for trajectory in trajectories:
            for name, counts in (
                ("condition", self.conditions),
                ("behaviour_policy", self.policies),
            ):
                if (column := trajectory.carried.get(name)) is not None:
                    counts.update(str(value) for value in column if value is not None)
            yield trajectory


def check_license(identifier: str | None) -> None:
    """Raise StoreError where it is no identifier as hubs of data sets write them."""
    if identifier is not None and not _IDENTIFIER.fullmatch(identifier):
        raise StoreError(
            f"{identifier!r} is not an identifier of a licence",
            where="--license",
            remedy="write it as hubs do, in small letters: cc-by-4.0, apache-2.0, other",
        )


def card(
    selection: Selection, counts: Counts, contents: Contents, to: str, identifier: str | None
) -> str:
    """Return the text of the card; without an identifier it says that no licence was given."""
    reported, task = counts.describe(), selection.task
    size = next((name for most, name in _SIZES if reported["transitions"] < most), "1M<n<10M")
    front = [
        *([f"license: {identifier}"] if identifier else []),
        "task_categories: [robotics, reinforcement-learning]",
        f"tags: [{_HUB_TAG[to]}, robotics, offline-rl, mobile-robots, restock]",
        f"size_categories: [{size}]",
    ]
    if to == "lerobot":
        front += ["configs:", "  - config_name: default", "    data_files: data/*/*.parquet"]
    action = (
        "the logged command, m/s ahead and rad/s to the left"
        if selection.continuous
        else f"one of {len(task.actions)}: " + ", ".join(task.action_names)
    )
    made = {
        "store version": selection.provenance.get("store_version"),
        "query": selection.provenance.get("query"),
        "panel": selection.provenance.get("panel"),
        "task": task.hash,
    }
    lines = [
        *("---", *front, "---", "", "# A mobile robot's transitions", ""),
        f"{reported['transitions']:,} transitions of {task.control_period_s:g} s in"
        f" {reported['trajectories']:,} trajectories, made from recordings by Restock:"
        f" {reported['terminated']:,} terminated, {reported['truncated']:,} truncated,"
        f" {reported['cut']:,} cut where rows were left out.",
        "",
        f"Read it with `{READ[to]}`.",
        "",
        *("## What is in it", ""),
        f"- Action: {action}.",
        f"- Observation: {selection.observation_size} numbers, by name: "
        + ", ".join(f"`{name}`" for name in task.observation_names)
        + ".",
        "- Reward: that of the task, recomputed from what was logged.",
        *(
            f"- `observation.images.{camera}`: at each step the last frame of the camera"
            f" `{camera}`, as far as it can be as recorded."
            for camera in selection.cameras
        ),
        *_table("condition", contents.conditions),
        *_table("behaviour policy", contents.policies),
        *("## How it was made", ""),
        *(f"- {name}: `{value}`" for name, value in made.items() if value is not None),
        *(f"- left out: {count:,}, {why}" for why, count in reported["left_out"].items()),
        "",
        *("## Before it is used", ""),
        "- Conditions are labels by rules over the signals, not the truth.",
        "- It is what somebody logged: how often a condition occurs here need not be how often it"
        " occurs.",
        "- A trajectory that was cut goes on: bootstrap there.",
        "",
        f"Licence: {identifier}."
        if identifier
        else "No licence was given: without one, nobody else may use it.",
    ]
    return "\n".join(lines) + "\n"


def _table(name: str, counts: Counter[str]) -> list[str]:
    if not counts:
        return []
    whole = sum(counts.values())
    rows = [f"| {key} | {count:,} | {count / whole:.1%} |" for key, count in counts.most_common()]
    return ["", f"| {name} | transitions | share |", "| --- | ---: | ---: |", *rows, ""]
