"""The rows that a mixture selects, by safety, age, caps, labels and store."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
from support.panels import EVERY, NO_SPLIT, by_priority, moment, panel_of, planned
from support.stores import CONDITIONS, recording_transitions, write_store

from restock.errors import MixtureError, StoreError
from restock.replay.mixture.mixture import parse_mixture
from restock.replay.mixture.share_controller import PlannedDraws
from restock.replay.panel.build import build_panel
from restock.replay.panel.logged_sampler import controller_for
from restock.replay.panel.panel import Panel
from restock.replay.plan.plan import PanelPlan, plan_panel
from restock.replay.store.store import Store


def selected_rows(plan: PanelPlan) -> pa.Table:
    return plan.rows.take(pa.array(plan.panel_rows))


def test_rows_have_one_stratum_or_one_exclusion_reason(transitions):
    now = moment(int(transitions["stamp_ns"].to_numpy().max()))
    text = (
        f"max_rows_per_episode = 20\nas_of = {now}\nmax_age_days = 0.05\nwhere = 'action <> 4'\n"
        "[safety]\nunsafe = 'bumped'\n" + EVERY
    )
    plan = planned(transitions, text)
    assert len(plan.left_out) == 5
    assert 4 not in selected_rows(plan)["action"].to_pylist()
    assert sum(plan.left_out.values()) + len(plan.panel_rows) == len(transitions)
    assert sum(line.rows for line in plan.strata) == len(plan.panel_rows)


@pytest.mark.parametrize("min_steps", [1, 2])
def test_episode_strata_hold_whole_episodes(transitions, min_steps):
    plan = planned(
        transitions,
        "uncertain = 'keep'\n" + NO_SPLIT + by_priority(CONDITIONS, f"min_steps = {min_steps}\n"),
    )
    assert len(plan.panel_rows) == len(transitions)  # nominal takes the remaining rows
    rows = selected_rows(plan)
    names = [line.name for line in plan.strata]
    stratum = dict(
        zip(
            rows["transition_id"].to_pylist(),
            (names[code] for code in plan.stratum.tolist()),
            strict=True,
        )
    )
    order = sorted(CONDITIONS, key=lambda condition: (condition.priority, condition.name))
    for episode in transitions["episode_id"].unique().to_pylist():
        own = transitions.filter(pc.equal(transitions["episode_id"], episode))
        held = own["conditions"].to_pylist()
        observed = [c.name for c in order if sum(c.name in row for row in held) >= min_steps]
        of_rows = {stratum[row] for row in own["transition_id"].to_pylist()}
        assert of_rows == {observed[0] if observed else "nominal"}
    assert {line.correction for line in plan.strata} == {"none"}


def test_unsafe_rows_or_their_episodes_are_left_out(transitions):
    bumped = set(transitions.filter(transitions["bumped"])["transition_id"].to_pylist())
    assert bumped
    rows = planned(transitions, NO_SPLIT + "[safety]\nunsafe = 'bumped'\n" + EVERY)
    assert rows.left_out == {"unsafe": len(bumped)}
    assert not bumped & set(selected_rows(rows)["transition_id"].to_pylist())
    whole = planned(
        transitions, NO_SPLIT + "[safety]\nunsafe = 'bumped'\nleave_out = 'episodes'\n" + EVERY
    )
    hit = set(transitions.filter(transitions["bumped"])["episode_id"].to_pylist())
    assert not hit & set(selected_rows(whole)["episode_id"].to_pylist())
    assert whole.left_out["unsafe"] > len(bumped)
    # A return may still span an unsafe step, as its cost is to be learnt.


@pytest.mark.parametrize("name", ["episode", "recording"])
def test_caps_per_episode_and_recording_hold_in_strata(transitions, name):
    text = f"max_rows_per_{name} = 7\n" + NO_SPLIT + EVERY
    plan = planned(transitions, text)
    rows = selected_rows(plan)
    groups = pa.table({"group": rows[f"{name}_id"], "code": plan.stratum[plan.panel_rows]})
    assert (
        pc.max(
            groups.group_by(["group", "code"]).aggregate([([], "count_all")])["count_all"]
        ).as_py()
        == 7
    )
    (reason,) = plan.left_out
    assert name in reason
    # The order of the rows does not matter; the seed does.
    again = planned(transitions.take(pa.array(np.arange(len(transitions))[::-1])), text)
    assert selected_rows(again)["transition_id"].to_pylist() == rows["transition_id"].to_pylist()
    other = planned(transitions, "seed = 1\n" + text)
    assert selected_rows(other)["transition_id"].to_pylist() != rows["transition_id"].to_pylist()


def test_unlabelled_rows_are_refused_dropped_or_nominal(transitions):
    bare = np.arange(len(transitions)) < 50
    table = transitions
    for name in ("condition", "conditions"):
        place = table.schema.get_field_index(name)
        field = table.schema.field(place).with_nullable(True)
        values = [
            None if gone else v for gone, v in zip(bare, table[name].to_pylist(), strict=True)
        ]
        table = table.set_column(place, field, pa.array(values, field.type))
    with pytest.raises(MixtureError, match=r"50 rows have no coverage label"):
        planned(table, NO_SPLIT + EVERY)
    dropped = planned(table, "unlabelled = 'drop'\n" + NO_SPLIT + EVERY)
    assert dropped.left_out == {"without a coverage label": 50}
    nominal = planned(table, "unlabelled = 'nominal'\n" + NO_SPLIT + EVERY)
    assert nominal.left_out == {}
    rows = {line.name: line.rows for line in nominal.strata}
    before = {line.name: line.rows for line in dropped.strata}
    assert rows["nominal"] == before["nominal"] + 50


OTHERS = """
[sources]
logs = 0.4
[[sources.stores]]
name = "twin"
path = "other@1"
share = 0.2
[evaluation_split]
by = "none"
"""


@pytest.fixture
def two_stores(tmp_path, store_path) -> Path:
    """Return a folder with store `other`: recordings 3 (also in the main store), 7, and later 8."""
    tables = [recording_transitions(index) for index in (3, 7, 8)]
    write_store(tmp_path / "other", tables)
    (tmp_path / "m.toml").write_text(OTHERS + EVERY)
    return tmp_path


def test_store_contained_in_main_store_is_refused(tmp_path, store_path, shell):
    rows = recording_transitions(3)
    write_store(tmp_path / "other", [rows])
    mixture = tmp_path / "m.toml"
    mixture.write_text(OTHERS.replace("@1", "") + EVERY)
    err = shell.err("mix", store_path, "--mixture", mixture, "--dry-run")
    assert f"all {len(rows)} rows of 'twin' are also in the main store" in err
    assert "leave this store out of the mixture" in err


def test_other_store_is_read_at_pinned_version(two_stores, store_path, shell):
    out = two_stores / "panel"
    words = ("mix", store_path, "--mixture", two_stores / "m.toml", "--out", out)
    document = shell.json(*words)
    (other,) = document["other_stores"]
    assert (other["name"], other["version"]) == ("twin", 1)
    repeated = len(recording_transitions(3))
    assert document["left_out"] == {"of 'twin', also in an earlier store": repeated}
    panel = Panel.open(out)
    assert panel.header.others[0].version == 1
    recordings = set(panel.meta["recording_id"].to_pylist())
    assert recordings == {f"{index:016x}" for index in (1, 2, 3, 7)}  # 8 came after version 1
    of_twin = [stratum for stratum in panel.strata if stratum.source == "twin"]
    assert of_twin[0].name == "twin/nominal"
    assert sum(stratum.share for stratum in of_twin) == pytest.approx(1 / 3)
    assert panel.header.logs_share == pytest.approx(0.6)
    stratum = np.array(panel.meta["stratum"].to_pylist())
    from_twin = np.char.startswith(stratum, "twin/")
    assert from_twin.sum() == len(recording_transitions(7))
    assert set(np.array(panel.meta["recording_id"].to_pylist())[from_twin]) == {f"{7:016x}"}
    # Packed rows are the rows of their store.
    truth = recording_transitions(7).select(["transition_id", "observation"]).to_pydict()
    rows = panel.rows[from_twin][:, panel.columns["observation"]]
    ids = panel.meta["transition_id"].to_numpy()[from_twin]
    by_id = dict(zip(truth["transition_id"], truth["observation"], strict=True))
    np.testing.assert_allclose(rows[:20], [by_id[i] for i in ids[:20].tolist()], rtol=1e-6)


def test_run_draws_from_stores_by_share(two_stores, store_path):
    text = OTHERS.replace('"other@1"', f'"{two_stores}/other@1"')
    panel = panel_of(store_path, text + EVERY, two_stores / "p")
    controller = controller_for(panel, PlannedDraws(640, 6400, 0, 1000), None)
    twin = np.array([stratum.source == "twin" for stratum in panel.strata])
    assert controller.logs_share == pytest.approx(0.6)
    assert controller.shares[twin].sum() == pytest.approx(1 / 3)


def test_missing_other_store_is_reported(store_path, tmp_path):
    mixture = parse_mixture(OTHERS + EVERY)
    with Store(store_path) as store:
        with pytest.raises(StoreError, match=r"the mixture's store 'twin': no such store"):
            build_panel(store, mixture, tmp_path / "panel")
        with pytest.raises(MixtureError, match=r"also draws from other stores \(twin\)"):
            plan_panel(store.connection, mixture, store.conditions())


def test_uncertain_rows_are_kept_dropped_or_nominal(transitions):
    labels = transitions["conditions"].to_pylist()
    # Every third slip, and some rows without a condition, are uncertain.
    slips = [i for i, held in enumerate(labels) if held == ["wheel_slip"]]
    doubtful = {*slips[::3], *[i for i, held in enumerate(labels) if not held][:40]}
    assert len(slips[::3]) > 3
    place = transitions.schema.get_field_index("uncertain")
    field = pa.field("uncertain", pa.list_(pa.string()))
    values = [["wheel_slip"] if row in doubtful else [] for row in range(len(labels))]
    table = transitions.set_column(place, field, pa.array(values, field.type))
    table = table.set_column(  # null in rows without such a rule
        place, field, pa.array([None if i % 7 == 0 and not v else v for i, v in enumerate(values)])
    )

    def planned_as(key: str) -> tuple[PanelPlan, dict[str, int]]:
        plan = planned(table, key + NO_SPLIT + EVERY)
        assert plan.uncertain_rows == len(doubtful)
        return plan, {line.name: line.rows for line in plan.strata}

    _, before = planned_as("uncertain = 'keep'\n")
    plan, rows = planned_as("")
    assert plan.left_out == {}
    assert rows["wheel_slip"] == before["wheel_slip"] - len(slips[::3])
    assert rows["nominal"] == before["nominal"] + len(slips[::3])
    # The panel keeps the store's condition of a row.
    by_id = dict(zip(transitions["transition_id"].to_pylist(), labels, strict=True))
    condition = selected_rows(plan).select(["transition_id", "condition"]).to_pylist()
    assert sum(row["condition"] == "wheel_slip" for row in condition) >= len(slips)
    assert all(row["condition"] in [*by_id[row["transition_id"]], "nominal"] for row in condition)
    plan, rows = planned_as("uncertain = 'drop'\n")
    assert plan.left_out == {"with an uncertain condition": len(doubtful)}
    assert rows["wheel_slip"] == before["wheel_slip"] - len(slips[::3])
    older = table.drop_columns(["uncertain"])
    assert planned(older, "uncertain = 'drop'\n" + NO_SPLIT + EVERY).left_out == {}


def test_unreachable_min_steps_selects_longest_episodes(transitions):
    """If no episode has `min_steps` steps of a condition, those with the most are selected."""
    labels = transitions.select(["episode_id", "conditions"]).to_pylist()
    steps: dict[str, int] = {}
    for row in labels:
        steps[row["episode_id"]] = steps.get(row["episode_id"], 0) + (
            "near_collision" in row["conditions"]
        )
    most = {episode for episode, count in steps.items() if count == max(steps.values())}
    text = "unlisted = 'drop'\n[[strata]]\nname = 'near_collision'\nunit = 'episode'\nmin_steps = "
    plan = planned(transitions, text + f"{max(steps.values()) + 5}\n" + NO_SPLIT)
    assert set(selected_rows(plan)["episode_id"].to_pylist()) == most
