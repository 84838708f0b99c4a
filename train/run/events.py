"""One stream of scalars by environment step, and the sinks that it goes to.

A sink that fails never ends a run: its failed calls are counted, the first reason is printed, and
after some failures in a row it is disabled. `RUN/tracking.json` has the counts and the ids by
which W&B and MLflow know the run.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from restock.files import first_line, write_text

TRACKING = "tracking.json"
GIVE_UP_AFTER = 3  # failures in a row: a server that is gone would cost its timeout every time


class Sink(Protocol):
    """Takes the curves of one run. Whatever its methods raise is caught and counted."""

    name: str

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """Numbers by `group/name`, after `step` environment steps."""

    def flush(self) -> None:
        """Make what was given readable from here on."""

    def close(self) -> None:
        """Close the sink: nothing more will come."""

    def describe(self) -> dict[str, Any]:
        """Return the ids and addresses by which the run is found again."""


class TensorBoard:
    """Event files in `RUN/tensorboard`."""

    name = "tensorboard"

    def __init__(self, folder: Path, from_step: int | None) -> None:
        from torch.utils.tensorboard import SummaryWriter

        # After a resume, what was written past the checkpoint is purged.
        self._writer: Any = SummaryWriter(str(folder), purge_step=from_step)

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        for name, value in values.items():
            self._writer.add_scalar(name, value, step)

    def flush(self) -> None:
        self._writer.flush()

    def close(self) -> None:
        self._writer.close()

    def describe(self) -> dict[str, Any]:
        return {}


@dataclass
class _Count:
    """The failed calls of a sink."""

    failed: int = 0
    in_a_row: int = 0
    first: str = ""


class Events:
    """Gives every number to every sink.

    Args:
        run: the run's directory.
        sinks: name -> what opens it.
        say: called when one fails for the first time, and at the end with the count.
    """

    def __init__(
        self,
        run: Path | None = None,
        sinks: Mapping[str, Callable[[], Sink]] | None = None,
        say: Callable[[str], None] | None = None,
    ) -> None:
        self._run, self._say = run, say or _to_stderr
        self._open: list[Sink] = []
        self.failures: dict[str, _Count] = {name: _Count() for name in sinks or {}}
        for name, opens in (sinks or {}).items():
            self._try(name, lambda opens=opens: self._open.append(opens()))  # type: ignore[misc]
        self._write()

    def scalars(self, step: int, prefix: str, values: Mapping[str, Any]) -> None:
        """Every number among `values`, as `prefix/name`."""
        numbers = {
            f"{prefix}/{name}": float(value)
            for name, value in values.items()
            if isinstance(value, int | float) and not isinstance(value, bool)
        }
        for sink in list(self._open):
            self._try(sink.name, lambda sink=sink: sink.scalars(step, numbers))  # type: ignore[misc]

    def flush(self) -> None:
        """Have every sink write what it holds."""
        for sink in list(self._open):
            self._try(sink.name, sink.flush)
        self._write()

    def close(self) -> None:
        """Close every sink, and say what they did not take."""
        for sink in list(self._open):
            self._try(sink.name, sink.close)
        for name, count in self.failures.items():
            if count.failed:
                calls = "call" if count.failed == 1 else "calls"
                self._say(f"{name} failed in {count.failed} {calls}; first: {count.first}")
        self._write()
        self._open = []

    def _try(self, name: str, call: Callable[[], object]) -> None:
        count = self.failures[name]
        try:
            call()
        except Exception as error:  # noqa: BLE001 - a tracker's own library may raise anything
            count.failed += 1
            count.in_a_row += 1
            if count.failed == 1:
                count.first = f"{type(error).__name__}: {first_line(error)}"
                self._say(f"{name} failed, training goes on: {count.first}")
            if count.in_a_row == GIVE_UP_AFTER:
                self._open = [sink for sink in self._open if sink.name != name]
                self._say(f"{name} failed {GIVE_UP_AFTER} times in a row: left alone from here on")
        else:
            count.in_a_row = 0

    def _write(self) -> None:
        described = {sink.name: sink.describe() for sink in self._open if sink.describe()}
        failed = {
            name: {"failed": count.failed, "first": count.first}
            for name, count in self.failures.items()
            if count.failed
        }
        if self._run is None or not (described or failed):
            return
        known = tracked(self._run)
        known.update(described)
        if failed:
            known["failures"] = failed
        write_text(self._run / TRACKING, json.dumps(known, indent=1) + "\n")


def tracked(run: Path) -> dict[str, Any]:
    """Read `RUN/tracking.json`; empty if it does not exist or cannot be read."""
    try:
        known = json.loads((run / TRACKING).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return known if isinstance(known, dict) else {}


def _to_stderr(text: str) -> None:
    sys.stderr.write(f"{text}\n")


__all__ = ["Events", "Sink", "TensorBoard", "tracked"]
