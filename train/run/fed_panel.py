"""The panel that a run was fed, as long as it is where it was, and no other is in its place."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from restock.errors import PanelError
from restock.replay.panel.panel import Panel


def run_panel(document: Mapping[str, Any]) -> Panel | None:
    """The panel that a run learnt from, by its `config.json`; None where it had none.

    Raises:
        PanelError: it cannot be read, or another one is in its place.
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
