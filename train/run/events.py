"""TensorBoard events beside the Parquet tables: the same curves, for those who watch them live."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any


class Events:
    """Writes scalars by environment step; does nothing when switched off."""

    def __init__(self, folder: Path, *, enabled: bool, from_step: int | None = None) -> None:
        self._writer: Any = None
        if enabled:
            from torch.utils.tensorboard import SummaryWriter

            # After a resume, what was written past the checkpoint is purged.
            self._writer = SummaryWriter(str(folder), purge_step=from_step)

    def scalars(self, step: int, prefix: str, values: Mapping[str, Any]) -> None:
        """Every number among `values`, as `prefix/name`."""
        if self._writer is None:
            return
        for name, value in values.items():
            if isinstance(value, int | float) and not isinstance(value, bool):
                self._writer.add_scalar(f"{prefix}/{name}", value, step)

    def flush(self) -> None:
        if self._writer is not None:
            self._writer.flush()

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()
