"""An archive of incidents represents natural rates: those of the main store, or given ones."""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.panels import panel_of
from support.stores import recording_transitions, write_store

from restock.errors import ConfigError, MixtureError
from restock.ingest.store.transitions import replaced
from restock.replay.mixture.mixture import CorrectionRule, StratumRule, parse_mixture
from restock.replay.mixture.shares import look_for_archives
from restock.replay.panel.build import open_source, write_panel
from restock.replay.panel.logged_sampler import sampler_for
from restock.replay.panel.panel import Panel
from restock.replay.plan.plan import PanelPlan, plan_panel
from restock.replay.plan.strata import ResolvedStratum
from restock.replay.plan.weights import effective_shares, importance_weights, rows_represented
from restock.replay.store.store import Store

TWO = """
[evaluation_split]
by = "none"
[sources]
logs = 0.25
{main}
[[sources.stores]]
name = "incidents"
path = "incidents"
share = 0.25
{archive}
[[strata]]
name = "nominal"
unit = "episode"
share = 0.5
[[strata]]
name = "near_collision"
unit = "episode"
share = 0.5
[correction]
pre = "{rule}"
below_natural = "allow"
"""


def recording(number: int, episodes: int, near: int) -> pa.Table:
    """Return a recording with a near collision in each of the first `near` episodes."""
    rows = recording_transitions(number, episodes=episodes)
    episode, step = rows["episode_index"].to_numpy(), rows["step_index"].to_numpy()
    held = (episode < near) & (step == 3)
    return replaced(
        rows,
        {
            "conditions": [["near_collision"] if one else [] for one in held],
            "condition": np.where(held, "near_collision", "nominal").tolist(),
            "uncertain": [[] for _ in held],
        },
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Return a folder with a store, 2 % of its episodes near collisions, and an archive."""
    folder = tmp_path_factory.mktemp("fleet")
    write_store(folder / "main", [recording(1, 100, 2)])
    write_store(folder / "incidents", [recording(2, 30, 25)])
    return folder


def planned(
    folder: Path,
    archive: str = "",
    main: str = "",
    rule: str = "none",
    first: str = "main",
    share: str = "0.5",
) -> PanelPlan:
    text = TWO.format(archive=archive, main=main, rule=rule).replace(
        "share = 0.5", f"share = {share}"
    )
    if first == "incidents":
        text = text.replace('path = "incidents"', 'path = "main"').replace(
            'name = "incidents"', 'name = "other"'
        )
    mixture = parse_mixture(text)
    with Store(folder / first) as store, open_source(store, mixture, folder=folder) as source:
        return plan_panel(source.connection, mixture, source.conditions, source.others)


def natural(plan: PanelPlan) -> dict[str, float]:
    return {line.name: line.natural_share for line in plan.strata}


def test_undeclared_archive_is_refused(folder):
    with pytest.raises(
        MixtureError, match="'incidents' looks like an archive: 25 of its 30"
    ) as error:
        planned(folder)
    assert "2 of 100" in error.value.what
    assert 'represents = "archive"' in str(error.value.remedy)
    assert "near_collision = 0.02" in str(error.value.remedy)


def test_main_store_can_be_archive(folder):
    with pytest.raises(MixtureError, match="'logs' looks like an archive") as error:
        planned(folder, first="incidents")
    assert "[sources]" in str(error.value.remedy)
    assert '"archive"' not in str(error.value.remedy)  # the main store cannot represent itself
    plan = planned(folder, main="represents = { near_collision = 0.03 }", first="incidents")
    assert natural(plan)["near_collision"] == pytest.approx(0.03)
    assert natural(plan)["nominal"] == pytest.approx(0.97)


@pytest.mark.parametrize(
    ("mine", "theirs", "refused", "warned"),
    [
        ((25, 65), (21, 182), False, True),  # 3.3 times as frequent, odds 4.7 times
        ((36, 40), (80, 200), True, True),  # a share of 40 % can rise 2.5-fold at most
        ((3, 6), (21, 182), False, False),  # few episodes, so by chance
        ((30, 100), (50, 182), False, False),
        ((180, 1000), (100, 1000), False, False),  # significantly more, but less than twice
        ((0, 0), (21, 182), False, False),  # without episodes
    ],
)
def test_archives_are_detected_by_odds(mine, theirs, refused, warned):
    declared = {"logs": None, "incidents": None}
    observed = {"near_collision": [theirs, mine]}
    if refused:
        with pytest.raises(MixtureError, match="looks like an archive"):
            look_for_archives(declared, observed, ["near_collision"])
    # A condition without a stratum cannot be given a rate, so it only warns.
    warnings = look_for_archives(declared, observed, ["all"] if refused else ["near_collision"])
    assert bool(warnings) == warned
    assert all("'incidents' may be an archive" in text for text in warnings)
    assert look_for_archives(declared | {"incidents": "archive"}, observed, ["all"]) == ()


def test_possible_archive_warns(tmp_path, shell):
    """Both conditions and exposures are compared, whatever the strata are."""
    write_store(tmp_path / "main", [recording(1, 100, 20)])
    write_store(tmp_path / "incidents", [recording(2, 30, 14)])
    plan = planned(tmp_path)
    assert "14 of its 30 episodes are of near_collision, 20 of 100" in plan.warnings[0]
    assert planned(tmp_path, 'represents = "natural"').warnings == ()

    exposed = recording(3, 30, 6)
    there = exposed["episode_index"].to_numpy() < 26  # in the main store, a third of the episodes
    names = [["closing_traffic"] if one else [] for one in there]
    write_store(tmp_path / "bags", [replaced(exposed, {"exposures": names})])
    (tmp_path / "m.toml").write_text(
        TWO.format(archive="", main="", rule="none").replace('path = "incidents"', 'path = "bags"')
    )
    requested = ("mix", tmp_path / "main", "--mixture", tmp_path / "m.toml", "--dry-run", "--json")
    out, err = shell.printed(*requested)
    assert "warning: the source 'incidents' may be an archive: 26 of its 30" in err
    assert len(json.loads(out)["warnings"]) == 1


def test_archive_represents_main_or_given_rates(folder):
    own = natural(planned(folder, 'represents = "natural"'))
    assert own["incidents/near_collision"] > 0.7 > 0.05 > own["near_collision"]
    archive = natural(planned(folder, 'represents = "archive"'))
    assert archive["incidents/near_collision"] == archive["near_collision"] == own["near_collision"]
    given_ = natural(planned(folder, "represents = { near_collision = 0.004 }"))
    assert given_["incidents/near_collision"] == pytest.approx(0.004)
    assert given_["incidents/nominal"] == pytest.approx(0.996)
    assert given_["near_collision"] == own["near_collision"]


def test_natural_shares_use_represented_rates(folder):
    plan = planned(folder, 'represents = "archive"', share='"natural"')
    lines = {line.name: line for line in plan.strata}
    assert lines["incidents/near_collision"].share == pytest.approx(
        lines["near_collision"].share  # each store supplies half of the logged rows
    )


def test_full_correction_restores_represented_rates(folder, tmp_path):
    """This holds in the plan, and in a run whose weights follow the shares."""
    archive = "represents = { near_collision = 0.02 }"
    plan = planned(folder, archive, rule="full")
    lines = {line.name: line for line in plan.strata}
    of_logs = lines["incidents/near_collision"].share + lines["incidents/nominal"].share
    rare = lines["incidents/near_collision"].effective_share / of_logs
    assert rare == pytest.approx(0.02, rel=1e-5)
    uncorrected = planned(folder, archive)
    boosted = next(s for s in uncorrected.strata if s.name == "incidents/near_collision")
    assert boosted.effective_share == boosted.share  # weighted only if requested

    mixture = plan.mixture
    with Store(folder / "main") as store, open_source(store, mixture, folder=folder) as source:
        panel = write_panel(source, plan, tmp_path / "panel")
    assert weighted_share(panel, "incidents/near_collision", "incidents/nominal") == pytest.approx(
        0.02, rel=1e-4
    )


def weighted_share(panel: Panel, stratum: str, other: str) -> float:
    """Return the first stratum's part of the weight that a run draws from two strata."""
    sampler, batches = sampler_for(panel, 128, seed=0), 40
    names = [line.name for line in panel.strata]
    part = dict.fromkeys((stratum, other), 0.0)
    for _ in range(batches):
        drawn = sampler.draw()
        for name in part:
            part[name] += float(drawn.weight[drawn.strata == names.index(name)].sum())
    return part[stratum] / sum(part.values())


CAPPED = """
unlisted = "drop"
{cap}
[evaluation_split]
by = "none"
[[strata]]
name = "nominal"
{nominal}
[[strata]]
name = "near_collision"
where = "list_contains(conditions, 'near_collision')"
timing = "pre"
{near}
[correction]
pre = "full"
"""


@pytest.mark.parametrize("shares", [("", ""), ("share = 0.6", "share = 0.4")])
def test_row_cap_per_episode_keeps_natural_rates(transitions, tmp_path, shares):
    """Natural shares and corrected rates stay the same, in the plan and in a run."""
    nominal, near = shares
    whole, capped = (
        panel_of(transitions, CAPPED.format(nominal=nominal, near=near, cap=cap), tmp_path / name)
        for name, cap in (("whole", ""), ("capped", "max_rows_per_episode = 4"))
    )
    of_whole, of_capped = ({s.name: s for s in panel.strata} for panel in (whole, capped))
    assert of_capped["nominal"].rows < of_whole["nominal"].rows / 2
    for name, line in of_whole.items():
        assert of_capped[name].natural_share == line.natural_share
        assert of_capped[name].share == pytest.approx(line.share)
        assert of_capped[name].effective_share == pytest.approx(line.natural_share, rel=1e-5)
    run = weighted_share(capped, "near_collision", "nominal")
    assert run == pytest.approx(of_whole["near_collision"].natural_share, rel=0.02)


def corrected_strata(rows: list[int], timing: str) -> tuple[list[ResolvedStratum], np.ndarray]:
    """Return fully corrected strata of so many rows each, and the stratum code of every row."""
    strata = [
        ResolvedStratum(StratumRule(name=f"s{i}"), "true", None, i, timing, "full")
        for i in range(len(rows))
    ]
    return strata, np.repeat(np.arange(len(rows)), rows).astype(np.int16)


@given(
    st.lists(st.integers(1, 200), min_size=2, max_size=5),
    st.data(),
    st.sampled_from(["pre", "post"]),
)
@settings(max_examples=100)
def test_weights_recover_natural_rates_exactly(rows, data, timing):
    """Full correction restores the rates for any numbers of rows and any shares."""
    size = len(rows)
    parts = st.lists(st.floats(0.01, 1.0), min_size=size, max_size=size)
    rates, shares = (np.array(data.draw(parts)) for _ in range(2))
    rates, shares = rates / rates.sum(), shares / shares.sum()
    strata, code = corrected_strata(rows, timing)
    state = code if timing == "pre" else np.full(len(code), -1, np.int16)
    rule = CorrectionRule(pre="full", post="full")
    weights = importance_weights(code, state, strata, shares, rule, None, rates)
    assert effective_shares(code, weights, shares) == pytest.approx(rates, rel=1e-4)
    # Rows that outcome probabilities are fitted on represent the same rates.
    represented = rows_represented(code, size, rates)
    assert represented.sum() == pytest.approx(len(code))
    assert np.bincount(code, represented) / len(code) == pytest.approx(rates)


@given(st.lists(st.integers(1, 50), min_size=2, max_size=4), st.data())
@settings(max_examples=30)
def test_natural_sample_represents_itself(rows, data):
    size = len(rows)
    shares = np.array(data.draw(st.lists(st.floats(0.1, 1), min_size=size, max_size=size)))
    strata, code = corrected_strata(rows, "pre")
    own = np.bincount(code) / len(code)
    rule, shares = CorrectionRule(), shares / shares.sum()
    assert importance_weights(code, code, strata, shares, rule, None, own) == pytest.approx(
        importance_weights(code, code, strata, shares, rule), rel=1e-5
    )
    assert rows_represented(code, size, None).tolist() == [1.0] * len(code)


@pytest.mark.parametrize(
    ("archive", "main", "named"),
    [
        ("represents = { near_colision = 0.1 }", "", "near_colision"),
        ('represents = "archive"', "represents = { near_collision = 0 }", "never occur"),
        ('represents = "incidents"', "", "represents"),
        ("represents = { near_collision = 0.7, nominal = 0.6 }", "", "sum to 1.3"),
        ("represents = { near_collision = 1.5 }", "", "near_collision|<= 1"),
        ("", 'represents = "archive"', "this is the main store"),
        ("represents = {}", "", "an empty table"),
        ("", "represents = {}", "an empty table"),
    ],
)
def test_invalid_rates_are_refused(folder, archive, main, named):
    with pytest.raises((MixtureError, ConfigError), match=named):
        planned(folder, archive, main, rule="full")
