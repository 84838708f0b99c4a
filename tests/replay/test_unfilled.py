"""Strata with a share and almost no rows are reported, each with a remedy."""

import re
from pathlib import Path
from typing import Any

import pytest
from support.paths import ROOT
from support.profile_texts import WAREHOUSE
from support.shell import Shell

from restock.cli import main

# In all 14 episodes of these logs the wheel speed drops by 0.25 m/s in a step, in one by 0.4.
BRAKING = """
[[condition]]
name = "hard_braking"
timing = "pre"
priority = 60
sql = "wheel_speed_mps - lag(wheel_speed_mps) OVER episode < -{}"
"""
NOMINAL = '[[strata]]\nname = "nominal"\nunit = "episode"\nshare = 0.4\n'
EACH = '[each_condition]\nunit = "episode"\nshare = "equal"\n'
LISTED = '[[strata]]\nname = "{}"\nunit = "{}"\nshare = "equal"\n'


@pytest.fixture(scope="module")
def braking(tmp_path_factory) -> Path:
    """Return a folder with a store of a real recording, every stop labelled as hard braking."""
    folder = tmp_path_factory.mktemp("braking")
    (folder / "amr.toml").write_text(WAREHOUSE + BRAKING.format(0.25))
    log, store = str(ROOT / "sample_logs" / "amr_tuesday"), str(folder / "store")
    profile = str(folder / "amr.toml")
    assert main(["ingest", log, "--store", store, "--profile", profile]) in (0, 3)
    return folder


class Mix:
    """Runs `restock mix --dry-run` with a mixture given as text."""

    def __init__(self, folder: Path, shell: Shell) -> None:
        self.file, self.shell = folder / "mine.toml", shell

    def words(self, store: Path, text: str) -> tuple[object, ...]:
        self.file.write_text(text)
        return "mix", store, "--mixture", self.file, "--dry-run"

    def __call__(self, store: Path, text: str) -> tuple[dict[str, dict[str, Any]], list[str]]:
        plan = self.shell.json(*self.words(store, text))
        return {line["stratum"]: line for line in plan["strata"]}, plan["warnings"]

    def err(self, store: Path, text: str, code: int = 2) -> str:
        return self.shell.err(*self.words(store, text), code=code)


@pytest.fixture
def mix(tmp_path: Path, shell: Shell) -> Mix:
    return Mix(tmp_path, shell)


def test_condition_in_every_episode_leaves_nominal_empty(braking, mix):
    store = braking / "store"
    strata, (warning,) = mix(store, NOMINAL + EACH)
    assert strata["nominal"]["rows"] == 0
    assert warning.startswith("nominal has no episode: each met the condition of another stratum")
    assert "warning: nominal has no episode" in mix.err(store, NOMINAL + EACH, code=0)
    # It is reported in a refusal, too.
    refused = mix.err(store, 'shortfall = "refuse"\n' + NOMINAL + EACH)
    assert "nominal wants 40.0%, and has no episode" in refused
    # The suggested remedies fill the stratum.
    for remedy in ('unit = "step"', 'unit = "episode"\nmin_steps = 2'):
        braked = f'[[strata]]\nname = "hard_braking"\nshare = "equal"\n{remedy}\n'
        strata, warnings = mix(store, NOMINAL + braked + EACH)
        assert strata["nominal"]["rows"] > 0
        assert warnings == []


def test_filled_strata_give_no_warning(store_path, mix):
    assert mix(store_path, "[each_condition]\nshare = 'natural'\n")[1] == []
    assert mix(store_path, "[each_condition]\nshare = 'equal'\n")[1] == []
    # An empty stratum without a wanted share is no mistake.
    never = '[[strata]]\nname = "never"\nwhere = "false"\nshare = {}\n[each_condition]\n'
    assert mix(store_path, never.format(0.0))[1] == []
    assert mix(store_path, never.format('"natural"'))[1] == []


def test_quota_without_logged_rows_is_reported(braking, mix):
    store = braking / "store"
    where = "where = \"NOT list_contains(conditions, 'wheel_slip')\"\n"
    strata, warnings = mix(store, where + "[each_condition]\nshare = 'equal'\n")
    assert strata["wheel_slip"]["rows"] == 0
    assert (
        "wheel_slip has no row that may be drawn: record some (`restock coverage gaps`), or leave"
        " it out of the strata" in warnings
    )
    own = '[[strata]]\nname = "wet_floor"\nwhere = "zone = \'nowhere\'"\nshare = 0.2\n'
    assert any(
        text.startswith("wet_floor has no row") and text.endswith("or change its `where`")
        for text in mix(store, own + EACH)[1]
    )
    unknown = mix.err(store, own.replace("where = \"zone = 'nowhere'\"\n", "") + EACH)
    assert "stratum 'wet_floor' is not a condition or exposure of these rows" in unknown
    assert "name one of nominal, " in unknown
    assert "or give it a `where`; or add it to the profile and run `restock store label`" in unknown


def test_unfillable_quotas_are_each_reported(store_path, mix):
    names = ("nominal", "recovery", "near_collision", "wheel_slip", "blocked_aisle")
    limit = "shortfall = 'refuse'\nmax_replays_per_row = 3\n[each_condition]\nshare = 'equal'\n"
    refused = mix.err(store_path, limit)
    for name in names:
        assert re.search(rf"^  {name} wants 20.0%, its .* rows in \d+ episodes allow 0.\d\d%$",
                         refused, re.MULTILINE)  # fmt: skip
    assert "lower the shares, raise max_replays_per_row" in refused
    floors = "[[strata]]\nname = 'nominal'\nshare = 0.9\n[each_condition]\nfloor = 0.1\n"
    assert (
        "the floors of recovery, near_collision, wheel_slip, blocked_aisle sum to 0.4"
        in mix.err(store_path, floors)
    )
