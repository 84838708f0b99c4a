"""No stratum is corrected below its natural share, and missing rows are reported."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.panels import EVERY, NO_SPLIT, by_priority, panel_of, planned
from support.stores import CONDITIONS

from restock.errors import MixtureError
from restock.replay.mixture.mixture import StratumRule, parse_mixture
from restock.replay.mixture.shares import missing_rows, plan_shares
from restock.replay.places import open_place
from restock.replay.plan.source_plan import below_natural
from restock.replay.plan.strata import NO_STRATUM, ResolvedStratum, assign, deal_episodes
from restock.replay.store.audit import Finding, load_audits, load_thresholds, run_audits

EQUAL = "planned_draws = 6400\n[each_condition]\nshare = 'equal'\n"


def test_correction_below_natural_share_is_refused(transitions):
    full = "[correction]\npost = 'full'\n"
    with pytest.raises(MixtureError) as refused:
        planned(transitions, EQUAL + full)
    allowed = planned(transitions, EQUAL + full + "below_natural = 'allow'\n")
    below = [line for line in allowed.strata if below_natural(line)]
    assert below
    assert {line.timing for line in below} == {"post"}  # chosen on the outcome
    for line in below:
        assert line.effective_share < line.natural_share < line.share
        for share in (line.natural_share, line.wanted_share, line.share, line.effective_share):
            assert f"{share:.2%}" in str(refused.value)
    assert 'below_natural = "allow"' in str(refused.value)
    assert '[correction] post = "density_ratio"' in str(refused.value)


@pytest.mark.parametrize("post", ["none", "full", "clipped", "density_ratio"])
def test_cap_below_natural_share_is_accepted(transitions, post):
    """Natural shares are not refused for rounding, and a cap below them is not a correction."""
    natural = planned(transitions, f"[correction]\npost = '{post}'\npre = 'full'\n" + EVERY)
    for line in natural.strata:
        assert line.effective_share == pytest.approx(line.natural_share, rel=1e-4)
    capped = planned(
        transitions,
        f"[correction]\npost = '{post}'\n[[strata]]\nname = 'wheel_slip'\ncap = 0.005\n" + EVERY,
    )
    slip = next(line for line in capped.strata if line.name == "wheel_slip")
    assert slip.share == pytest.approx(0.005)
    assert slip.effective_share > 0.99 * slip.share


def episode_strata(count: int) -> list[ResolvedStratum]:
    rules = [StratumRule(name=f"s{i}", unit="episode") for i in range(count)]
    rules.append(StratumRule(name="nominal", unit="episode"))
    return [ResolvedStratum(rule, "true", None, i, "pre", "none") for i, rule in enumerate(rules)]


@settings(max_examples=150)
@given(st.data())
def test_every_stratum_gets_episode_if_possible(data):
    count = data.draw(st.integers(1, 5), label="strata")
    sets = st.frozensets(st.integers(0, count - 1))
    observed = data.draw(st.lists(sets, min_size=1, max_size=30), label="met")
    size = np.array([data.draw(st.integers(1, 9)) for _ in observed])
    episode = np.repeat(np.arange(len(observed)), size)
    member = np.array([[*(s in one for s in range(count)), True] for one in observed])[episode]
    strata = episode_strata(count)
    code = assign(member, strata)
    got = deal_episodes(code, member, episode, strata, np.ones(len(episode), np.bool_))
    assert len(got) == len(observed)
    for one, stratum in zip(observed, got.tolist(), strict=True):
        assert stratum in one if one else stratum == NO_STRATUM
    rows = np.array([size[got == s].sum() for s in range(count)])
    for s in range(count):
        could = [i for i, one in enumerate(observed) if s in one]
        alone = [i for i in could if len(observed[i]) == 1]
        assert set(alone) <= set(np.flatnonzero(got == s).tolist())
        # A stratum is empty only if it has fewer episodes than there are strata that want them.
        if could and not rows[s]:
            rivals = set().union(*(observed[i] for i in could)) - {s}
            assert rivals
            assert len(could) <= sum(len([i for i in could if got[i] == r]) for r in rivals)
    again = deal_episodes(code, member, episode, strata, np.ones(len(episode), np.bool_))
    assert got.tolist() == again.tolist()


def test_episode_counts_for_its_rarest_condition():
    # Two episodes met both; the second condition was met in eight more.
    observed = [{0, 1}, {0, 1}, *({1} for _ in range(8)), set()]
    episode = np.repeat(np.arange(len(observed)), 10)
    member = np.array([[0 in one, 1 in one, True] for one in observed])[episode]
    for order in ([1, 0], [0, 1]):  # whichever comes first by priority
        strata = episode_strata(2)
        strata = [
            replace(stratum, priority=priority)
            for stratum, priority in zip(strata, [*order, 9], strict=True)
        ]
        code = assign(member, strata)
        given = deal_episodes(code, member, episode, strata, np.ones(len(episode), np.bool_))
        assert given.tolist() == [0, 0, *([1] * 8), NO_STRATUM]


def test_priorities_of_episode_strata(transitions):
    each = "[each_condition]\nunit = 'episode'\n" + NO_SPLIT
    rarest = {line.name: line.rows for line in planned(transitions, each).strata}
    listed = NO_SPLIT + by_priority(CONDITIONS)
    first = {line.name: line.rows for line in planned(transitions, listed).strata}
    assert min(rows for name, rows in rarest.items() if name != "nominal") > min(
        rows for name, rows in first.items() if name != "nominal"
    )
    own = "[[strata]]\nname = 'wheel_slip'\nunit = 'episode'\npriority = 1\n" + each
    kept = {line.name: line.rows for line in planned(transitions, own).strata}
    labels = transitions.select(["episode_id", "conditions"]).to_pylist()
    slipped = {row["episode_id"] for row in labels if "wheel_slip" in row["conditions"]}
    assert kept["wheel_slip"] == sum(row["episode_id"] in slipped for row in labels)


def test_missing_rows_would_fill_stratum():
    text = "max_replays_per_row = 50\nplanned_draws = 100_000\n" + EVERY
    mixture = parse_mixture(text)
    rules = [StratumRule(name="nominal", share=0.5), StratumRule(name="rare", share=0.5)]
    rows, episodes, draws = np.array([10_000, 93]), np.array([100, 10]), 50_000.0
    plan = plan_shares(mixture, rules, rows, episodes, draws=draws)
    missing = missing_rows(mixture, rows, plan.wanted, draws)
    assert missing.tolist() == [0, 407]  # 25,000 draws at 50 a row are 500 rows
    filled = plan_shares(mixture, rules, rows + missing, episodes, draws=draws)
    np.testing.assert_allclose(filled.got, filled.wanted)
    # Without a limit one row is enough.
    free, none = parse_mixture(EVERY), np.array([10_000, 0])
    assert missing_rows(free, none, plan.wanted, draws).tolist() == [0, 1]


def test_missing_rows_count_only_admitted_recordings(transitions):
    text = "max_replays_per_row = 40\n[each_condition]\nshare = 'equal'\n" + NO_SPLIT
    recording, *others = pc.unique(transitions["recording_id"]).to_pylist()
    assert others
    alone = planned(transitions.filter(pc.field("recording_id") == recording), text)
    of_all = planned(transitions, f"where = \"recording_id = '{recording}'\"\n{text}")
    assert alone.found.keys() == of_all.found.keys() != set()
    for name, found in alone.found.items():
        of_episodes = of_all.found[name]
        assert found.tolist() == of_episodes[~np.isnan(of_episodes)].tolist()


def test_plan_shows_four_shares_and_missing_rows(store_path, tmp_path, shell):
    (tmp_path / "m.toml").write_text(
        "max_replays_per_row = 40\n[each_condition]\nunit = 'episode'\nshare = 'equal'\n"
    )
    arguments = ["mix", str(store_path), "--mixture", str(tmp_path / "m.toml"), "--dry-run"]
    lines = shell.json(*arguments)["strata"]
    short = [line for line in lines if line["missing_rows"]]
    assert short
    for line in short:
        assert line["note"]
    text = shell.out(*arguments)
    for name in ("natural: %", "wanted: %", "drawn: % of", "% of their"):
        assert name in text
    assert "% wanted" not in text  # only the table has this number
    assert f"{short[0]['missing_rows']:,} more rows would fill it" in text


def finding_on(store: Path, name: str, **places: Path) -> Finding:
    """Return an audit's finding on a panel or a run of the store."""
    (audit,) = [audit for audit in load_audits() if audit.name == name]
    with open_place(store, beside=places) as connection:
        return run_audits(connection, [audit], {name: load_thresholds()[name]}, beside=[*places])[0]


def test_audit_finds_weights_that_undo_quota(store_path, tmp_path):
    allow = EQUAL + "[correction]\npost = '{}'\nbelow_natural = 'allow'\n"
    for post, status in (("full", "fail"), ("none", "pass")):
        panel = panel_of(store_path, allow.format(post), tmp_path / post)
        finding = finding_on(store_path, "panel_effective_share", panel=panel.path)
        assert finding.status == status
        below = [line.name for line in panel.strata if below_natural(line)]
        assert {row["stratum"] for row in finding.sample} == set(below)

    run = tmp_path / "run"
    run.mkdir()
    (run / "config.json").write_text("{}")
    lines = [  # stratum, natural share, drawn rows, effective share; the same in two intervals
        ("nominal", 0.90, 60, 0.62),
        ("wheel_slip", 0.04, 30, 0.01),
        ("recovery", 0.06, 10, 0.37),
    ]
    rows = [
        {"source": "logs", "stratum": stratum, "gradient_steps": step, "available_share": natural}
        | {"drawn_rows": drawn, "effective_share": after}
        for stratum, natural, drawn, after in lines
        for step in (100, 200)
    ]
    pq.write_table(pa.Table.from_pylist(rows), run / "strata.parquet")
    fed = [  # stratum, wanted, drawn rows
        ("nominal", 0.5, 80),
        ("wheel_slip", 0.1, 15),
        ("recovery", 0.4, 5),
    ]
    rows = [
        {"phase": "online", "stratum": stratum, "gradient_steps": step, "natural_share": 0.1}
        | {"wanted_share": wanted, "drawn_rows": drawn, "short_share": 0.35, "reason": "few"}
        for stratum, wanted, drawn in fed
        for step in (100, 200)
    ]
    pq.write_table(pa.Table.from_pylist(rows), run / "fed.parquet")
    finding = finding_on(store_path, "effective_share", run=run)
    starved, row = finding.sample  # short in the batch, then reduced by weights
    assert (starved["stratum"], starved["source"], starved["reason"]) == (
        "recovery",
        "batch",
        "few",
    )
    assert (starved["wanted_share"], starved["drawn_share"]) == pytest.approx((0.4, 0.05))
    assert (finding.status, row["stratum"]) == ("fail", "wheel_slip")
    assert row["drawn_share"] == pytest.approx(0.3)
    assert row["effective_share"] == pytest.approx(0.01)
