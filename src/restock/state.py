"""State in checkpoints: a class names the attributes that are saved and restored, no others.

A class lists its attributes in `STATE`. Each is an array, a number, a string, None, a list or dict
of those, a random generator, a tensor, a torch module, a dataclass or msgspec struct, or another
object with `state_dict` and `load_state_dict`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any, ClassVar

import msgspec
import numpy as np

from restock.errors import RunError


class Stateful:
    """A class whose attributes in `STATE` are saved and restored.

    Attributes in `SAME` are saved as well; loading fails if their values differ. Subclasses
    override `restored` to recompute what depends on the state.
    """

    STATE: ClassVar[tuple[str, ...]] = ()
    SAME: ClassVar[tuple[str, ...]] = ()
    # Attribute -> type, if its current value does not show the type, as an empty list of structs.
    STATE_TYPES: ClassVar[Mapping[str, Any]] = {}

    def state_dict(self) -> dict[str, Any]:
        """Return arrays and JSON values by attribute name, without a leading underscore."""
        return {_key(name): saved(getattr(self, name)) for name in (*self.SAME, *self.STATE)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what `state_dict` saved; raise `mismatch` if an attribute in `SAME` differs.

        Raises:
            RunError: an attribute is missing, because another version of Restock saved the state.
        """
        for name in self.SAME:
            if not _alike(saved(getattr(self, name)), state.get(_key(name))):
                raise self.mismatch(_key(name), state.get(_key(name)))
        self.expect_state(state, self.STATE)
        for name in self.STATE:
            value, kind = state[_key(name)], self.STATE_TYPES.get(name)
            if kind is None:
                setattr(self, name, restored(getattr(self, name), value))
            else:
                setattr(self, name, msgspec.convert(value, kind, str_keys=True))
        self.restored()

    def expect_state(self, state: Mapping[str, Any], names: Sequence[str]) -> None:
        """Raise RunError if one of these names is missing in a state."""
        own = type(self).__name__
        if lacking := next((_key(name) for name in names if _key(name) not in state), None):
            raise RunError(
                f"the saved state of {own} has no {lacking}: another version of Restock saved it",
                remedy="resume with the version that the run began with, or start another run",
            )

    def restored(self) -> None:
        """Finish after `load_state_dict`; subclasses override it."""

    def mismatch(self, name: str, value: Any) -> Exception:
        """Return the error for a state in which an attribute in `SAME` has another `value`."""
        return ValueError(f"the saved state is of another {type(self).__name__}: {name} {value}")


def saved(value: Any) -> Any:
    """Convert a value to arrays and JSON values; nothing shares memory with it."""
    if isinstance(value, np.random.Generator):
        return value.bit_generator.state
    if isinstance(value, Stateful):
        return value.state_dict()
    if hasattr(value, "state_dict"):  # a torch module or optimizer: copy the tensors it returns
        return saved(dict(value.state_dict()))
    if hasattr(value, "detach"):  # a tensor
        return value.detach().cpu().clone()
    if hasattr(value, "get_state"):  # a torch.Generator
        return value.get_state().clone()
    if isinstance(value, np.ndarray):
        return value.copy()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, msgspec.Struct):
        return msgspec.to_builtins(value)
    if is_dataclass(value):
        return {field.name: saved(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):  # JSON needs strings as keys
        return {str(name): saved(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [saved(item) for item in value]
    return value


def first_mismatch(error: RuntimeError) -> str:
    """Return the first mismatch of names or shapes from PyTorch's error about loaded weights."""
    lines = str(error).splitlines()
    return lines[min(1, len(lines) - 1)].strip()


def restored(current: Any, state: Any) -> Any:
    """Convert a saved state to the type of `current`; objects with a state are changed in place."""
    if isinstance(current, np.random.Generator):
        current.bit_generator.state = state
        return current
    if hasattr(current, "load_state_dict"):
        try:
            current.load_state_dict(state)
        except RuntimeError as error:  # raised by torch.nn.Module
            raise RunError(
                f"the saved state is of another network: {first_mismatch(error)}",
                remedy="give the settings and the task that it was saved with",
            ) from error
        return current
    if state is None:
        return None
    if hasattr(current, "detach"):
        return state.to(current.device, current.dtype, copy=True)
    if hasattr(current, "get_state"):
        current.set_state(state.cpu())
        return current
    if isinstance(current, np.ndarray):
        return np.array(state, current.dtype)
    if is_dataclass(current) and not isinstance(current, type):
        values = {name: restored(getattr(current, name), item) for name, item in state.items()}
        return type(current)(**values)
    if isinstance(current, dict) and current.keys() == state.keys():
        return {name: restored(item, state[name]) for name, item in current.items()}
    if isinstance(current, list | tuple) and len(current) == len(state):
        pairs = zip(current, state, strict=True)
        return type(current)(restored(item, one) for item, one in pairs)
    if isinstance(current, bool | int | float):
        return type(current)(state)
    return saved(state)


def _alike(one: Any, other: Any) -> bool:
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        return other is not None and np.array_equal(one, other)
    return bool(one == other)


def _key(name: str) -> str:
    return name.removeprefix("_")
