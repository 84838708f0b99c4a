"""Find the profile and the panel of a run by its `config.json`.

A run contains the text of its profile, so that it can be read anywhere. Its panel is a folder
elsewhere, which must still be the panel that the run learned from.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from restock.errors import ConfigError, PanelError, RestockError, RunError
from restock.ingest.profile.profile import (
    Profile,
    load_profile,
    parse_profile,
    profile_toml,
    shipped_profiles,
)
from restock.replay.panel.panel import Panel
from restock.train.run.run import Run


def profile_document(profile: Profile) -> dict[str, object]:
    """Return what `config.json` has about the profile, in runs of Restock and other libraries."""
    return {
        "task_hash": profile.task.hash,
        "actions": profile.task.action_names,
        "labels_version": profile.labels_version,
        "profile": {"name": profile.name, "hash": profile.hash},
        "profile_toml": profile_toml(profile),
    }


def profile_of_run(run: Run) -> Profile:
    """Return the profile that a run was trained with, from the text that the run contains.

    Raises:
        RunError: the text cannot be read, or the run has no profile at all.
        ConfigError: an older Restock wrote the run without the text, and the profile is not found.
    """
    text, config = run.document.get("profile_toml", ""), run.document["config"]
    if not text and "profile" not in config:
        raise RunError("its rows are a table of another task: no profile", where=str(run.path))
    if not text:
        return load_profile(config["profile"])
    try:
        return parse_profile(text, where="profile_toml")
    except ConfigError as error:
        raise RunError(
            f"the profile in it cannot be read: {error.what}",
            where=str(run.path / "config.json"),
            remedy="it may be written by a newer Restock (use that version); else restore the "
            "file from a copy",
        ) from error


def carries_profile(panel: Panel, name: str) -> bool:
    """Return whether `name` is the profile that the panel contains, not a shipped one or a file."""
    own = panel.header.profile_toml and name == panel.header.profile
    return bool(own) and name not in shipped_profiles() and not Path(name).is_file()


def profile_of_panel(panel: Panel) -> Profile:
    """Return the profile of a panel's task, for use if the user names no profile.

    Raises:
        PanelError: the panel contains no usable profile, and no shipped profile has its task.
    """
    header = panel.header
    name, text = header.profile, header.profile_toml
    option = f"--set profile={name or 'my_robot'}.toml"
    return carried_profile(name, text, panel.task_hash, str(panel.path), option, PanelError)


def carried_profile(
    name: str, text: str, task_hash: str, where: str, option: str, error: type[RestockError]
) -> Profile:
    """Return the profile of a task: from the `text` kept with its rows, else a shipped one.

    `option` is the command-line option that gives another profile; the error's remedy names it.

    Raises:
        error: neither the text nor a shipped profile has this task.
    """
    problem, remedy = (
        "",
        (f"give the file of the profile with which its logs were ingested: {option}"),
    )
    if text:
        try:
            own = parse_profile(text, where=where)
            if own.task.hash == task_hash:
                return own
            problem = f"; with this Restock, the profile that it contains defines {own.task.hash}"
            remedy = (
                "the meaning of observation or reward has changed since: ingest its recordings "
                "again (`restock ingest RECORDINGS --store STORE`), and mix again"
            )
        except ConfigError as refused:
            problem = f"; the profile that it contains cannot be read: {refused.what}"
    fitting = [p for p in map(load_profile, shipped_profiles()) if p.task.hash == task_hash]
    if not fitting:
        raise error(
            f"its rows are of task {task_hash}"
            + (f", of profile {name!r}" if name else "")
            + f": no shipped profile has this task{problem}",
            where=where,
            remedy=remedy,
        )
    return next((profile for profile in fitting if profile.name == name), fitting[0])


def run_panel(document: Mapping[str, Any]) -> Panel | None:
    """Open the panel that a run learnt from, by its `config.json`; None if there was none.

    Raises:
        PanelError: the panel is gone or cannot be read, or another panel is in its place.
    """
    fed = document.get("panel")
    if fed is None:
        return None
    if not (path := Path(fed["path"])).exists():
        raise PanelError(
            f"there is no panel here any more; the run was fed {fed.get('id', 'it')}",
            where=str(path),
            remedy="move it back, put a link to it there, or mix it there again from the same store"
            " version and mixture",
        )
    panel = Panel.open(path)
    if panel.id != fed.get("id", panel.id):
        raise PanelError(
            f"is panel {panel.id}, the run was fed {fed['id']}",
            where=str(fed["path"]),
            remedy="mix the run's panel there again, from the same store version and mixture",
        )
    return panel
