"""Check that a run is evaluated only with the panel that it was fed."""

from pathlib import Path

import pytest
from support.panels import EVERY, NO_SPLIT, panel_of
from support.stores import recording_transitions, write_store

from restock.errors import PanelError
from restock.train.run.run_profile import run_panel


def test_replaced_panel_is_rejected(tmp_path: Path) -> None:
    store, out = write_store(tmp_path / "store", [recording_transitions(1)]), tmp_path / "panel"
    fed = panel_of(store, EVERY + NO_SPLIT, out)
    document = {"panel": {"path": str(out), "id": fed.id}}
    held = run_panel(document)
    assert held is not None
    assert held.id == fed.id
    assert run_panel({"panel": None}) is None
    other = panel_of(store, "n_step = 2\n" + EVERY + NO_SPLIT, out, force=True)
    assert other.id != fed.id
    with pytest.raises(PanelError, match=f"is panel {other.id}, the run was fed {fed.id}"):
        run_panel(document)
    out.rename(tmp_path / "moved")
    with pytest.raises(PanelError, match=rf"the run was fed {fed.id}\n  move it back, put a link"):
        run_panel(document)
