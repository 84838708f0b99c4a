"""An exported policy as a robot uses it: the network, and all that its metadata says of the task.

`restock export RUN --to onnx` writes it. What the robot needs stands in it: the profile as TOML,
which says what to subscribe to and what observation, actions and limits are. No PyTorch is needed.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from restock.arrays import F32
from restock.errors import ConfigError
from restock.files import first_line
from restock.imports import import_extra
from restock.ingest.profile.profile import Profile, load_profile, read_profile_toml

FORMAT = "restock-policy/1"
_REMEDY = "give the file that `restock export RUN --to onnx --out policy.onnx` wrote"


class PolicyFile:
    """A policy and its profile.

    Raises:
        ConfigError: no such file, not a policy of Restock, one whose profile cannot be read, is not
            at hand or is of another task; or the extra `onnx` is not installed.
    """

    def __init__(self, path: Path, profile: Path | str | None = None) -> None:
        """`profile` is a file or a name in place of the profile that the policy carries."""
        self.path = path
        self._session = open_session(path)
        metadata = self._session.get_modelmeta().custom_metadata_map
        if metadata.get("format") != FORMAT:
            raise ConfigError(
                "is an ONNX model without a task: it was not exported by Restock",
                where=str(path),
                remedy="restock export RUN --to onnx --out policy.onnx",
            )
        self.version = f"{metadata.get('run', '')} {metadata.get('version', '')}".strip()
        self.profile = _profile(metadata, path, profile)
        task, (taken, *more) = self.profile.task, self._session.get_inputs()
        if task.hash != metadata.get("task_hash"):
            raise ConfigError(
                f"was made for task {metadata.get('task_hash')}, profile {self.profile.name!r}"
                f" defines {task.hash}",
                where=str(path),
                remedy="export it again from a run of this task, with this Restock",
            )
        if more or taken.shape[-1] != task.observation_size:
            raise ConfigError(
                f"takes {[each.shape for each in (taken, *more)]}, the observation is"
                f" (N, {task.observation_size})",
                where=str(path),
            )
        self._input = taken.name

    def act(self, observation: F32) -> int | None:
        """Return the best action for an observation (D,); None if its value is not finite.

        Raises:
            ConfigError: the network's output is none of the task's actions.
        """
        outputs = self._session.run(["action", "values"], {self._input: observation[None]})
        (action,), (values,) = outputs
        if not 0 <= action < len(self.profile.task.actions):
            raise ConfigError(f"chose action {action}, which does not exist", where=str(self.path))
        # Of values that are not numbers the first is the largest: the action would mean nothing.
        return int(action) if np.isfinite(values[action]) else None


def open_session(path: Path) -> Any:
    """Open an ONNX session of a file, on one thread.

    Raises:
        ConfigError: no such file, a folder, no ONNX model, or the runtime is not installed.
    """
    runtime = import_extra("onnxruntime", "onnx", "an exported policy is run by onnxruntime")
    if not path.is_file():
        what = "is a folder, not an ONNX file" if path.is_dir() else "no such file"
        raise ConfigError(what, where=str(path), remedy=_REMEDY)
    options = runtime.SessionOptions()
    options.intra_op_num_threads = 1  # a small network: handing it out costs more
    options.log_severity_level = 4
    try:
        return runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise ConfigError(
            f"is not an ONNX model: {first_line(error)}", where=str(path), remedy=_REMEDY
        ) from error


def _profile(metadata: dict[str, str], path: Path, given: Path | str | None) -> Profile:
    if given is not None:
        return load_profile(given)
    if text := metadata.get("profile_toml"):
        return read_profile_toml(text, where=f"{path}: profile_toml")
    try:
        return load_profile(metadata.get("profile", ""))
    except ConfigError as error:
        raise ConfigError(
            f"contains no profile, and no profile named {metadata.get('profile', '')!r} was found",
            where=str(path),
            remedy="export it again with this Restock, or give its profile's file",
        ) from error


__all__ = ["FORMAT", "PolicyFile", "open_session"]
