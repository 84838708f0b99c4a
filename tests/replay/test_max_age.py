"""`max_age_days` of a mixture is relative to the time of mixing, not to the newest row."""

import time

import pytest
from support.panels import EVERY, NO_SPLIT, moment, panel_of
from support.stores import START_NS, recording_transitions

from restock.errors import MixtureError
from restock.replay.panel.panel import Panel

DAY_NS = 86_400 * 10**9
NOW_NS = START_NS + 264 * DAY_NS + 30 * 10**9  # the rows are 264 days old


@pytest.fixture(autouse=True)
def clock(monkeypatch) -> None:
    monkeypatch.setattr(time, "time_ns", lambda: NOW_NS)


def test_age_is_relative_to_time_of_mixing(tmp_path):
    rows = recording_transitions(0)
    with pytest.raises(MixtureError, match=r"older than max_age_days = 30: .* 26\d\.\d days old"):
        panel_of(rows, "max_age_days = 30\n" + NO_SPLIT + EVERY, tmp_path / "a")
    assert not (tmp_path / "a").exists()
    panel = panel_of(rows, "max_age_days = 300\n" + NO_SPLIT + EVERY, tmp_path / "b")
    assert len(panel) == len(rows)
    assert Panel.open(panel.path).header.as_of_ns == NOW_NS
    oldest = panel_of(rows, "max_age_days = 1e300\n" + NO_SPLIT + EVERY, tmp_path / "d")
    assert len(oldest) == len(rows)
    without = panel_of(rows, NO_SPLIT + EVERY, tmp_path / "c")
    assert without.header.as_of_ns is None  # the panel does not depend on the clock


def test_panel_is_reproduced_with_its_as_of_time(tmp_path, monkeypatch):
    text = NO_SPLIT + EVERY
    first = panel_of(recording_transitions(0), "max_age_days = 264\n" + text, tmp_path / "a")
    assert 0 < len(first) < len(recording_transitions(0))
    monkeypatch.setattr(time, "time_ns", lambda: NOW_NS + 90 * DAY_NS)
    with pytest.raises(MixtureError, match="every row is older"):
        panel_of(recording_transitions(0), "max_age_days = 264\n" + text, tmp_path / "b")
    assert first.header.as_of_ns is not None
    pinned = f"as_of = {moment(first.header.as_of_ns)}\nmax_age_days = 264\n" + text
    again = panel_of(recording_transitions(0), pinned, tmp_path / "c")
    assert again.header.files["rows.f32"] == first.header.files["rows.f32"]
    same = panel_of(recording_transitions(0), pinned, tmp_path / "d")
    assert same.id == again.id
