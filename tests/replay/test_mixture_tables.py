"""`mixture(name)` and `mixture_rows(name)` in SQL: the plan that `restock mix` packs."""

from pathlib import Path

import pyarrow as pa
import pytest
from support.long import one_in
from support.panels import EVERY, NO_SPLIT
from support.stores import recording_transitions, write_store

from restock.replay.mixture.mixture import load_mixture
from restock.replay.panel.build import open_source, write_panel
from restock.replay.panel.mixture_tables import ROWS, STRATA
from restock.replay.places import add_computed_tables
from restock.replay.plan.plan import plan_panel
from restock.replay.store.store import Store

MIXTURES = {
    "coverage": None,
    "steps and caps": "n_step = 3\nmax_rows_per_episode = 5\nseed = 4\n" + EVERY,
    "weighted": "[correction]\npost = 'full'\nbelow_natural = 'allow'\n"
    "[each_condition]\nshare = 'equal'\n",
    "split by recording": "[evaluation_split]\nby = 'recording'\nshare = 0.3\n" + EVERY,
    "other store": "[[sources.stores]]\nname = 'twin'\npath = 'other'\nshare = 0.2\n"
    "[sources]\nlogs = 0.4\n" + NO_SPLIT + EVERY,
    "where, and a share of 0": "where = 'action <> 2'\nunlisted = 'drop'\n"
    "[[strata]]\nname = 'wheel_slip'\nshare = 0.0\n" + EVERY,
    "unlabelled": "unlabelled = 'nominal'\n" + EVERY,
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Return a folder with `store`, `other`, and `half`, some of whose rows have no labels."""
    path = tmp_path_factory.mktemp("stores")
    first = recording_transitions(1)
    bare = [None if row < 30 else held for row, held in enumerate(first["conditions"].to_pylist())]
    place = first.schema.get_field_index("conditions")
    field = first.schema.field(place).with_nullable(True)
    unlabelled = first.set_column(place, field, pa.array(bare, field.type))
    write_store(path / "store", [recording_transitions(2), recording_transitions(3)])
    write_store(path / "half", [unlabelled, recording_transitions(2)])
    write_store(path / "other", [recording_transitions(7)])
    return path


@pytest.mark.parametrize("name", one_in(2, MIXTURES))
def test_mix_packs_rows_of_mixture_tables(folder, tmp_path, name):
    text, mixture = MIXTURES[name], name
    if text is not None:
        mixture = str(folder / "mixture.toml")
        Path(mixture).write_text(text)
    with Store(folder / ("half" if name == "unlabelled" else "store")) as store:
        add_computed_tables(store)
        strata = store.sql(f"FROM mixture('{mixture}')").to_arrow_table()
        rows = store.sql(f"FROM mixture_rows('{mixture}')").to_arrow_table()
        loaded = load_mixture(mixture)
        with open_source(store, loaded, folder=folder) as source:
            plan = plan_panel(source.connection, loaded, source.conditions, source.others)
            panel = write_panel(source, plan, tmp_path / "panel")
    assert (strata.column_names, rows.column_names) == (list(STRATA), list(ROWS))
    for column in ("transition_id", "recording_id", "episode_id", "step_index", "stratum"):
        assert rows[column].to_pylist() == panel.meta[column].to_pylist(), column
    assert rows["weight"].to_pylist() == panel.weights.tolist()
    of_panel = {line.name: line for line in panel.strata}
    for line in strata.to_pylist():
        other = of_panel.pop(line["stratum"])
        assert line["drawn_share"] == other.share
        for column in STRATA.keys() - {"stratum", "drawn_share"}:
            assert line[column] == getattr(other, column), column
    assert not of_panel
    counted = {line["stratum"]: line["rows"] for line in strata.to_pylist() if line["drawn_share"]}
    rows_of = rows.group_by("stratum").aggregate([([], "count_all")]).to_pylist()
    assert counted == {line["stratum"]: line["count_all"] for line in rows_of}


def test_changed_mixture_file_is_planned_again(folder, tmp_path):
    path = tmp_path / "m.toml"
    path.write_text("seed = 1\n" + EVERY)
    with Store(folder / "store") as store:
        add_computed_tables(store)
        query = f"SELECT list(transition_id ORDER BY transition_id) FROM mixture_rows('{path}')"
        first = store.sql(query).fetchall()
        assert store.sql(query).fetchall() == first
        path.write_text("seed = 2\n" + EVERY)  # another evaluation split
        assert store.sql(query).fetchall() != first


def test_mixture_tables_follow_version_and_join(folder, shell):
    store = str(folder / "store")
    query = (
        "SELECT stratum, any_value(m.rows) AS rows, count(*) AS packed"
        " FROM mixture('uniform') AS m JOIN mixture_rows('uniform') USING (stratum)"
        " JOIN transitions USING (transition_id) GROUP BY ALL"
    )
    newest = shell.json("sql", store, query)
    assert newest
    assert all(row["rows"] == row["packed"] for row in newest)
    older = shell.json("sql", f"{store}@0", query)
    assert sum(row["rows"] for row in older) < sum(row["rows"] for row in newest)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("coverag", "no mixture 'coverag'"),
        ("missions", "now called 'coverage'"),
        ("{folder}/wrong.toml", "unknown key `seeed`"),
        ("{folder}/refused.toml", "of the gradient after weights"),
    ],
)
def test_invalid_mixtures_are_refused(folder, name, message, shell):
    (folder / "wrong.toml").write_text("seeed = 1\n" + EVERY)
    (folder / "refused.toml").write_text(
        "[correction]\npost = 'full'\n[each_condition]\nshare = 'equal'\n"
    )
    name = name.format(folder=folder)
    for macro in ("mixture", "mixture_rows"):
        err = shell.err("sql", folder / "store", f"FROM {macro}('{name}')")
        assert message in err
        assert "UDF" not in err
