"""Mixtures: valid files, how shares are computed, and the weights that correct a boost."""

import json
import re

import msgspec
import numpy as np
import pytest
from support.panels import EVERY, planned
from support.paths import ROOT

from restock.errors import ConfigError, MixtureError
from restock.ingest.task.conditions import Condition
from restock.replay.mixture.mixture import (
    CorrectionRule,
    EachCondition,
    EvaluationSplit,
    Mixture,
    OtherStore,
    Prioritised,
    Safety,
    SourceShares,
    StratumRule,
    parse_mixture,
)
from restock.replay.mixture.shares import plan_shares, wanted_shares
from restock.replay.plan.strata import ResolvedStratum, resolve_strata
from restock.replay.plan.weights import importance_weights


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (EVERY + "sahre = 1", "sahre"),
        (
            EVERY
            + "[sources]\nlogs = 0.9\n[[sources.stores]]\nname = 'b'\npath = 'b'\nshare = 0.5",
            "sources sum to 1.4",
        ),
        (EVERY + "[sources]\nlogs = 0.0", "sources.logs must be above 0"),
        (EVERY + "[adaptive]\nfloor = 0.7", "unknown key `adaptive`"),
        ('[[strata]]\nname = "nominal"\nmin_rows = 9', "unknown key"),
        ('[[sources.stores]]\nname = "a"\npath = "b"\nversion = 1', "as in STORE@12"),
        (
            "[[strata]]\nname = 'a'\nshare = 0.1\nfloor = 0.2",
            "share of 'a' is 0.1, below its floor",
        ),
        ("[[strata]]\nname = 'a'\nshare = 0.3\ncap = 0.2", r"\.share of 'a' is 0.3, above"),
        (EVERY + "[[strata]]\nname = ''\nwhere = 'true'", "a stratum needs a name"),
        (EVERY + "[safety]\nleave_out = 'rows'", "unsafe"),
        ("max_rows_per_episode = 0\n" + EVERY, "max_rows_per_episode"),
        ("within = 'rank'\n" + EVERY, "within is 'rank': the rules are uniform"),
        (EVERY + "within = 'rank'", "within is 'rank'"),
        ("discount = 1.5\n" + EVERY, "discount"),
        ("seed = 'x'\n" + EVERY, "seed"),
        ("discount = 0.9", "no strata"),
        ("[[strata]]\nname = 'a'\nshare = 0.7\n[[strata]]\nname = 'b'\nshare = 0.7", "sum to 1.4"),
        ("[[strata]]\nname = 'a'\n[[strata]]\nname = 'a'", "named twice"),
        ("[[strata]]\nname = 'a'\nshare = 'some'", "share"),
        ("[[strata]]\nname = 'a'\nfloor = 0.5\ncap = 0.4", r"floor of 'a' is 0.5, above its cap"),
        ("[[strata]]\nname = 'a'\nunit = 'mission'", "unit"),
        ("[[strata]]\nname = 'a'\nmin_steps = 3", 'needs unit = "episode"'),
        ("[each_condition]\nunit = 'episode'\nmin_steps = 0", "at least 1"),
        ("shortfall = 'ignore'\n" + EVERY, "shortfall"),
        ("not toml", "mixture"),
    ],
)
def test_invalid_mixtures_are_refused(text, message):
    with pytest.raises(ConfigError, match=message):
        parse_mixture(text)


SLIPS_ALONE = "[[strata]]\nname = 'nominal'\n[[strata]]\nname = 'wheel_slip'\n"


@pytest.mark.parametrize(
    ("text", "error", "named"),
    [
        ("[[strata]]\nname = 'ice'\n", ConfigError, "wheel_slip"),
        ("[[strata]]\nname = 'x'\nwhere = 'speed > 1'\n", ConfigError, "stratum 'x'"),
        ("where = 'speed > 1'\n" + EVERY, ConfigError, "`where`"),
        # SQL that only fails on rows
        (EVERY + "[safety]\nunsafe = 'zone'", ConfigError, "safety.unsafe"),
        (EVERY + "[safety]\nunsafe = 'zone::INTEGER > 1'", ConfigError, "safety.unsafe"),
        (EVERY + "[safety]\nunsafe = 'count(*) > 1'", ConfigError, "safety.unsafe"),
        # SQL that is not one expression
        ("where = 'step_index > 3) OR (true'\n" + EVERY, ConfigError, "brackets"),
        ("where = '(step_index > 3'\n" + EVERY, ConfigError, "`where`"),
        ("where = 'step_index > 3; SELECT 1'\n" + EVERY, ConfigError, "`where`"),
        (EVERY + "[safety]\nunsafe = 'true'", MixtureError, "unsafe"),  # leaves no row
        (SLIPS_ALONE, MixtureError, "recovery"),  # rows of recovery are in no stratum
    ],
)
def test_mixtures_that_do_not_fit_rows_are_refused(transitions, text, error, named):
    with pytest.raises(error, match=re.escape(named)):
        planned(transitions, text)


def test_rows_without_stratum_can_be_dropped(transitions):
    plan = planned(transitions, "unlisted = 'drop'\n" + SLIPS_ALONE)
    assert plan.left_out["in no stratum"] > 0
    assert sum(plan.left_out.values()) + len(plan.panel_rows) == len(transitions)


@pytest.mark.parametrize(
    ("sql", "name"),
    [
        ("random() < .5", "random"),
        ("stamp_ns < epoch_ns(now())", "now"),
        ("current_date > DATE '2026-01-01'", "current_date"),
        ("age(make_timestamp_ns(stamp_ns)::TIMESTAMP) > INTERVAL 1 DAY", "age"),
        ("transition_id IN (SELECT 1 WHERE uuid() IS NOT NULL)", "uuid"),
        ("row_number() OVER (PARTITION BY episode_id) < 9", "without ORDER BY"),
        ("any_value(zone) OVER (PARTITION BY episode_id) = 'aisle'", r"any_value\(\) .*without"),
        ("(list(reward) OVER ())[1] > 0", r"list\(\) .*without ORDER BY"),
        ("sum(reward) OVER (ROWS 3 PRECEDING) > 0", r"sum\(\) .*without ORDER BY"),
    ],
)
def test_nondeterministic_sql_is_refused(transitions, sql, name):
    for table in ("where", "[safety]\nunsafe", "[[strata]]\nname = 'x'\nwhere"):
        with pytest.raises(ConfigError, match=name):
            planned(transitions, f'{table} = "{sql}"\n{EVERY}')


def test_deterministic_sql_is_accepted(transitions):
    sql = (
        "md5_number_lower(episode_id) % 10 < 9",
        "row_number() OVER (PARTITION BY episode_id ORDER BY transition_id) < 9",
        "sum(reward) OVER (PARTITION BY episode_id) > -1e9",
        "count(*) OVER (ROWS BETWEEN UNBOUNDED PRECEDING AND UNBOUNDED FOLLOWING) > 1",
        "first(reward ORDER BY transition_id) OVER (PARTITION BY episode_id) > -1e9",
        "len(list(reward ORDER BY step_index) OVER (PARTITION BY episode_id)) > 1",
        "arg_max(reward, step_index) OVER (PARTITION BY episode_id) > -1e9",
        "date_trunc('day', to_timestamp(stamp_ns / 1e9) AT TIME ZONE 'UTC') > '2020-01-01'",
        "CASE WHEN stamp_ns < 0 THEN error('bad') ELSE true END",
    )
    text = f'where = "{" AND ".join(sql)}"\n'
    assert len(planned(transitions, text + EVERY).panel_rows)


def test_fixed_natural_and_equal_shares():
    def wanted(*given: object, **more: object) -> list[float]:
        rules = [StratumRule(name=str(i), share=s) for i, s in enumerate(given)]  # type: ignore[arg-type]
        counts = more.get("rows", [600, 300, 100])
        return [round(float(share), 6) for share in wanted_shares(rules, np.array(counts))]

    assert wanted(0.5, 0.3, 0.2) == [0.5, 0.3, 0.2]
    assert wanted(0.4, "equal", "equal") == [0.4, 0.3, 0.3]
    assert wanted(0.2, "natural", "natural") == [0.2, 0.6, 0.2]
    assert wanted("natural", "natural", "natural") == [0.6, 0.3, 0.1]
    # Each gets an equal part; natural strata divide theirs by rows.
    assert wanted("equal", "natural", "natural") == [0.333333, 0.5, 0.166667]
    with pytest.raises(MixtureError, match=r"sum to 0\.9"):
        wanted(0.5, 0.3, 0.1)


def test_shortfall_is_redistributed_shrunk_or_refused():
    # 1,000 updates x 100 rows x 1/2 = 50,000 draws; 100 rows x 50 replays = 5,000: a share of 0.1.
    text = "max_replays_per_row = 50\nplanned_draws = 100_000\n" + EVERY
    rules = [StratumRule(name="nominal", share=0.5), StratumRule(name="rare", share=0.5)]
    rows, episodes = np.array([10_000, 100]), np.array([100, 10])
    plan = plan_shares(parse_mixture(text), rules, rows, episodes, draws=50_000)
    np.testing.assert_allclose(plan.got, [0.9, 0.1])
    np.testing.assert_allclose(plan.wanted, [0.5, 0.5])
    assert plan.notes == ("took the surplus", "short of rows")
    assert plan.scale == 1.0
    shrunk = plan_shares(
        parse_mixture("shortfall = 'shrink'\n" + text), rules, rows, episodes, draws=50_000
    )
    assert shrunk.scale == pytest.approx(0.6)
    np.testing.assert_allclose(shrunk.got, [0.5 / 0.6, 0.1 / 0.6])
    with pytest.raises(MixtureError, match=r"rare wants 50\.0%, its 100 rows in 10 episodes"):
        plan_shares(
            parse_mixture("shortfall = 'refuse'\n" + text), rules, rows, episodes, draws=50_000
        )
    # If no stratum can take the surplus, the logs' part of the batch shrinks.
    small = plan_shares(parse_mixture(text), rules, np.array([300, 100]), episodes, draws=50_000)
    assert small.scale == pytest.approx(0.4)
    np.testing.assert_allclose(small.got, [0.75, 0.25])


def test_fractional_replay_limit_is_rounded_down(transitions):
    # A run draws a row once if the limit is 1.5.
    text = (
        "max_replays_per_row = {}\nplanned_draws = 640\n[correction]\npost = 'none'\n"
        "[[strata]]\nname = 'wheel_slip'\nshare = 0.5\n" + EVERY
    )
    assert planned(transitions, text.format(1.5)).strata == (
        planned(transitions, text.format(1)).strata
    )


def test_strata_take_their_timing_from_conditions():
    conditions = [Condition("slip", "post", "x", 30), Condition("blocked", "pre", "x", 40)]
    mixture = parse_mixture("[correction]\npost = 'clipped'\n" + EVERY)
    found = {s.name: s for s in resolve_strata(mixture, conditions)}
    assert [s.name for s in found.values()] == ["nominal", "slip", "blocked"]
    assert (found["slip"].timing, found["slip"].correction) == ("post", "clipped")
    assert (found["blocked"].timing, found["blocked"].correction) == ("pre", "none")
    assert found["slip"].priority == 30
    where = parse_mixture("[[strata]]\nname = 'x'\nwhere = 'action = 1'\n")
    assert resolve_strata(where, conditions)[0].timing == "post"  # the safe assumption


def test_slip_rows_get_density_of_nominal_rows(transitions):
    """Rows that hold only a slip are weighted to nominal density, so that P(s'|s, a) is kept."""
    full = "[correction]\npost = 'full'\nbelow_natural = 'allow'\n"
    plan = planned(transitions, full + "[[strata]]\nname = 'nominal'\nshare = 0.2\n" + EVERY)
    names = [line.name for line in plan.strata]
    slip, nominal = names.index("wheel_slip"), names.index("nominal")
    chosen = plan.panel_rows
    code, state = plan.stratum[chosen], plan.beside["state_code"]
    labels = transitions.sort_by(
        [("recording_id", "ascending"), ("episode_index", "ascending"), ("step_index", "ascending")]
    )["conditions"].to_pylist()
    only_slip = np.array([labels[row] == ["wheel_slip"] for row in chosen])
    assert only_slip.any()
    assert (state[only_slip] == nominal).all()
    share = np.array([line.share for line in plan.strata])
    density = (share / np.array([line.rows for line in plan.strata]))[code] * plan.weight
    np.testing.assert_allclose(
        density[only_slip & (code == slip)], density[code == nominal][0], rtol=1e-5
    )


def test_clipped_correction_is_between_none_and_full():
    code = np.repeat(np.array([0, 1], np.int16), [100, 9900])
    state = np.ones(10_000, np.int16)
    given = np.array([0.5, 0.5])

    def ratio(correction: str, **rule: float) -> float:
        strata = [
            ResolvedStratum(StratumRule(name="outcome"), "true", None, 0, "post", correction),  # type: ignore[arg-type]
            ResolvedStratum(StratumRule(name="nominal"), "true", None, 1, "pre", "none"),
        ]
        weights = importance_weights(code, state, strata, given, CorrectionRule(**rule))
        return float(weights[-1] / weights[0])

    assert ratio("none") == pytest.approx(1)
    assert ratio("full") == pytest.approx(99)  # boosted 50 times, the others 50/99 times
    assert ratio("clipped", clip=4.0) == pytest.approx(4)


def test_plan_counts_replays(transitions):
    plan = planned(transitions, "planned_draws = 6400\n[sources]\nlogs = 0.25\n" + EVERY)
    draws = sum(line.replays_per_row * line.rows for line in plan.strata)
    assert draws == pytest.approx(100 * 64 * 0.25)
    assert plan.effective_rows == pytest.approx(len(plan.panel_rows), rel=1e-3)


def test_mix_verb_explains_packs_and_never_overwrites(store_path, tmp_path, shell):
    out = tmp_path / "panel"
    text = shell.out("mix", store_path, "--out", out, "--dry-run")
    assert "near_collision" in text
    assert "nothing was written" in text
    assert not out.exists()
    document = shell.json("mix", store_path, "--out", out)
    assert sum(line["share"] for line in document["strata"]) == pytest.approx(1)
    assert document["store_version"] == 2
    before = (out / "panel.json").read_bytes()
    assert json.loads(before)["id"] == document["id"]
    assert "already there" in shell.err("mix", store_path, "--out", out)
    assert (out / "panel.json").read_bytes() == before
    assert "no --out" in shell.err("mix", store_path)


def test_mix_verb_reports_planned_draws(store_path, tmp_path, shell):
    text = shell.out("mix", store_path, "--dry-run")
    assert "these numbers are for 2,560,000 draws of logged rows" in text
    assert "no row is drawn more than 400 times (max_replays_per_row)" in text
    # So few rows cannot supply the default training budget.
    assert "warning: at the default training budget (51,500 updates of 128 rows)" in text
    (tmp_path / "m.toml").write_text("planned_draws = 12_800\n[sources]\nlogs = 1\n" + EVERY)
    requested = ["mix", str(store_path), "--mixture", str(tmp_path / "m.toml"), "--dry-run"]
    text = shell.out(*requested)
    assert "these numbers are for 12,800 draws of logged rows" in text
    assert "max_replays_per_row" not in text


def test_docs_page_explains_every_key():
    page = (ROOT / "docs" / "mixture.md").read_text(encoding="utf-8")
    structs = (
        *(Mixture, StratumRule, EachCondition, EvaluationSplit, SourceShares, CorrectionRule),
        *(OtherStore, Safety, Prioritised),
    )
    for struct in structs:
        for field in msgspec.structs.fields(struct):
            name = field.encode_name
            forms = (
                f"`{name}`",
                f"`[{name}]`",
                f"[[{name}]]`",
                f"[[sources.{name}]]`",
                f"{name} = ",
            )
            assert any(form in page for form in forms), name
