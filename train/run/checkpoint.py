"""Checkpoints: one file of tensors and JSON; a kill while it is written leaves the old one.

A checkpoint is a safetensors file. Its metadata has a JSON document, and a checksum over the
document and all tensors, so that a file that changed since is refused. Loading executes no code.
State is a nested mapping whose leaves are tensors, numpy arrays, numbers, strings, booleans, None
or lists of those; `save` stores arrays as tensors named by their path, and `load` puts them back.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from restock.errors import RunError
from restock.files import temporary_name

FORMAT = "restock-checkpoint/5"
_EARLIER = tuple(f"restock-checkpoint/{number}" for number in (1, 2, 3, 4))
_ARRAY, _STRINGS, _NUMPY = "__array__", "__strings__", "numpy"
_RESTORE = "restore it from a copy, or train again"


def save(path: Path, state: Mapping[str, Any]) -> None:
    """Write `state` to `path`, replacing an existing file in one step.

    Raises:
        TypeError: a leaf has another type than the module's docstring lists; names its path.
    """
    tensors: dict[str, torch.Tensor] = {}
    document = json.dumps(_take_apart(state, "", tensors))
    metadata = {"format": FORMAT, "state": document, "blake2b": _checksum(document, tensors)}
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = temporary_name(path)
    try:
        save_file(tensors, temporary, metadata=metadata)
        with temporary.open("rb") as written:
            os.fsync(written.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def load(path: Path) -> dict[str, Any]:
    """Load the state that `save` wrote: numpy arrays as numpy arrays, tensors as CPU tensors.

    Raises:
        RunError: there is no such file, or it is damaged, or `save` did not write it.
    """
    if not path.is_file():
        raise RunError(
            "there is no checkpoint",
            where=str(path),
            remedy="a run that stopped before its first one has nothing to continue from: remove"
            " it, and train again",
        )
    try:
        with safe_open(path, framework="pt") as opened:
            metadata = opened.metadata() or {}
            form = metadata.get("format")
            if form in _EARLIER:
                raise RunError(
                    f"was written by an earlier Restock ({form}, this one reads {FORMAT})",
                    where=str(path),
                    remedy="train again with `restock train`",
                )
            if form != FORMAT:
                raise RunError("is not a checkpoint of Restock", where=str(path))
            tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
        document, expected = metadata.get("state", ""), metadata.get("blake2b", "none")
        if (actual := _checksum(document, tensors)) != expected:
            raise RunError(
                f"is damaged: its checksum is {actual}, not {expected}",
                where=str(path),
                remedy=_RESTORE,
            )
        restored = _put_together(json.loads(document), tensors)
    except (SafetensorError, OSError, ValueError, LookupError) as error:
        raise RunError(f"is damaged: {error}", where=str(path), remedy=_RESTORE) from error
    if not isinstance(restored, dict):
        raise RunError("contains no state", where=str(path))
    return restored


def _checksum(document: str, tensors: Mapping[str, torch.Tensor]) -> str:
    """Return blake2b of a checkpoint's content, 32 hex digits."""
    digest = hashlib.blake2b(document.encode(), digest_size=16)
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"\n{name} {tensor.dtype} {list(tensor.shape)}\n".encode())
        if tensor.numel():
            digest.update(tensor.contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def _take_apart(value: Any, path: str, tensors: dict[str, torch.Tensor]) -> Any:
    if isinstance(value, torch.Tensor):
        # A copy, because safetensors refuses tensors that share memory.
        tensors[path] = value.detach().to("cpu", copy=True).contiguous()
        return {_ARRAY: path}
    if isinstance(value, np.ndarray):
        if value.dtype == np.bool_ or value.dtype.kind in "iuf":
            tensors[path] = torch.from_numpy(np.array(value, order="C", copy=True))
            return {_ARRAY: path, _NUMPY: True}
        if value.dtype.kind == "U":
            return {_STRINGS: value.tolist(), _NUMPY: value.dtype.str}
        raise TypeError(f"{path}: arrays of {value.dtype} cannot be kept in a checkpoint")
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str) or key in (_ARRAY, _STRINGS):
                raise TypeError(f"{path}: keys must be strings, got {key!r}")
        return {
            key: _take_apart(item, f"{path}/{key}" if path else key, tensors)
            for key, item in value.items()
        }
    if isinstance(value, list | tuple):
        return [_take_apart(item, f"{path}/{index}", tensors) for index, item in enumerate(value)]
    if isinstance(value, np.generic):
        return value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"{path}: {type(value).__name__} cannot be kept in a checkpoint")


def _put_together(value: Any, tensors: Mapping[str, torch.Tensor]) -> Any:
    if isinstance(value, dict):
        if _ARRAY in value:
            tensor = tensors[value[_ARRAY]]
            return tensor.numpy() if value.get(_NUMPY) else tensor
        if _STRINGS in value:
            return np.array(value[_STRINGS], dtype=value[_NUMPY])
        return {key: _put_together(item, tensors) for key, item in value.items()}
    if isinstance(value, list):
        return [_put_together(item, tensors) for item in value]
    return value
