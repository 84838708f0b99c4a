"""A custom draw rule: one class and one row of RULES."""

import numpy as np
import pytest
from support.library_buffers import make_store
from support.panels import panel_of

from restock.errors import ConfigError
from restock.replay import RULES, Panel, Rule, StratumDraws, StratumRows, sampler_for

MIXTURE = """
within = "recent"
correction = {pre = "none", post = "none"}
[evaluation_split]
by = "none"
[each_condition]
share = "natural"
"""


class Recent(StratumDraws):
    """Draws the newest tenth of a stratum's rows, with replacement."""

    def __init__(self, rows: StratumRows) -> None:
        newest_first = np.argsort(rows.column("stamp_ns"), kind="stable")[::-1]
        self.newest = newest_first[: max(len(rows) // 10, 1)]

    def draw(self, count: int, rng: np.random.Generator, batches: int):  # type: ignore[no-untyped-def]
        return rng.choice(self.newest, count), None


@pytest.fixture
def recent_panel(tmp_path, monkeypatch) -> Panel:
    monkeypatch.setitem(RULES, "recent", Rule(Recent, "the newest tenth"))
    return panel_of(make_store(tmp_path), MIXTURE, tmp_path / "panel")


def test_sampler_draws_by_custom_rule(recent_panel):
    sampler, stamps = sampler_for(recent_panel, 64, seed=0), recent_panel.meta_column("stamp_ns")
    drawn = [sampler.draw() for _ in range(50)]
    rows = np.concatenate([one.rows for one in drawn])
    strata = np.concatenate([one.strata for one in drawn])
    for number, stratum in enumerate(recent_panel.stratum_rows()):
        of_stratum = rows[strata == number]
        if len(of_stratum):
            newest = np.sort(stamps[stratum])[::-1][: max(len(stratum) // 10, 1)]
            assert stamps[of_stratum].min() >= newest.min()


def test_unknown_rule_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="the rules are uniform, without_replacement, per"):
        panel_of(make_store(tmp_path), MIXTURE, tmp_path / "panel")
