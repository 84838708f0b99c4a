"""The last few checkpoints of a run: the latest, and earlier ones by their environment steps.

checkpoints/latest.safetensors
checkpoints/env_steps_000040000.safetensors
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from restock.errors import RunError

_PREFIX, _SUFFIX = "env_steps_", ".safetensors"


def earlier(latest: Path) -> dict[int, Path]:
    """The checkpoints before the latest, oldest first, by their environment steps."""
    found = {}
    for path in latest.parent.glob(f"{_PREFIX}*{_SUFFIX}"):
        steps = path.name.removeprefix(_PREFIX).removesuffix(_SUFFIX)
        if steps.isdigit():
            found[int(steps)] = path
    return dict(sorted(found.items()))


def keep(latest: Path, env_steps: int, count: int) -> None:
    """Before the latest, taken after `env_steps`, is replaced: of `count` in all, keep it as one.

    It stays where it is until then, so a kill at any instant leaves a latest one.
    """
    if count > 1 and latest.exists():
        named = latest.with_name(f"{_PREFIX}{env_steps:09d}{_SUFFIX}")
        _put(latest, named)
    for path in list(earlier(latest).values())[: -(count - 1) or None]:
        path.unlink()


def check_earlier(latest: Path, env_steps: int) -> dict[int, Path]:
    """The checkpoints before the latest, one of which was taken after these environment steps.

    Raises:
        RunError: none was; names those that there are.
    """
    found = earlier(latest)
    if env_steps not in found:
        there = ", ".join(f"{steps}" for steps in found) or "none"
        raise RunError(
            f"no earlier checkpoint was taken after {env_steps} environment steps",
            where=str(latest.parent),
            remedy=f"those that are kept: {there}",
        )
    return found


def go_back(latest: Path, env_steps: int) -> None:
    """Make an earlier checkpoint the latest; those after it are forgotten.

    Raises:
        RunError: see `check_earlier`.
    """
    found = check_earlier(latest, env_steps)
    _put(found[env_steps], latest)
    for steps, path in found.items():
        if steps >= env_steps:
            path.unlink()


def _put(source: Path, target: Path) -> None:
    """The same file under another name, in one step; a copy where the disk has no hard links."""
    temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    temporary.unlink(missing_ok=True)
    try:
        try:
            os.link(source, temporary)
        except OSError:
            shutil.copyfile(source, temporary)
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)


__all__ = ["check_earlier", "earlier", "go_back", "keep"]
