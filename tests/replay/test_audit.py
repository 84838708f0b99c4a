"""Each audit finds the fault planted for it, and nothing in clean data."""

import json
import re
import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.panels import panel_of
from support.stores import manifest, recording_transitions, views_over, write_store

from restock import cli
from restock.errors import ConfigError
from restock.ingest.store.transitions import replaced
from restock.ingest.store.writer import StoreWriter
from restock.replay.panel.panel import Panel
from restock.replay.places import open_place
from restock.replay.store import definitions
from restock.replay.store.audit import (
    Audit,
    Finding,
    junit_suites,
    load_audits,
    load_thresholds,
    run_audits,
    shipped_audits,
)
from restock.replay.store.definitions import install_named
from restock.replay.store.store import Store

AUDITS = {audit.name: audit for audit in shipped_audits()}
Tables = tuple[pa.Table, pa.Table]  # transitions, recordings
TABLE = re.compile(r"\b(FROM|INTO|UPDATE) (transitions|recordings)\b")  # changed by a fault


@pytest.fixture(scope="module")
def clean() -> Tables:
    """Return recent data of every condition, on which all audits but those of NOT_CLEAN pass."""
    tables = [recording_transitions(index, episodes=120) for index in (1, 2)]
    recordings = pa.concat_tables([manifest(table) for table in tables])
    table = pa.concat_tables(tables)
    # All rows are of one week: drift would compare two weeks.
    now = datetime.now(UTC)
    monday = (now - timedelta(days=now.weekday() + 7)).replace(hour=0, minute=0, second=0)
    recent = int(monday.timestamp()) * 10**9 + 10**14
    return replaced(table, {"stamp_ns": table["stamp_ns"].to_numpy() % 10**13 + recent}), recordings


FAULTS = [  # audit, number of rows found, part of the first row, SQL that plants the fault
    (name, int(rows), json.loads(first), sql)
    for name, rows, first, sql in re.findall(
        r"^-- (\w+) (\d+) ({[^\n]*})(.+?)(?=^-- \w+ \d|\Z)",
        Path(__file__).with_name("planted_faults.sql").read_text(),
        re.MULTILINE | re.DOTALL,
    )
]


def findings_of(tables: Tables, names: list[str], sql: str = "", **limits: float) -> list[Finding]:
    """Return the findings of audits after `sql` has changed the tables."""
    thresholds = load_thresholds()
    chosen = {n: thresholds[n] | limits for n in names if AUDITS[n].parameters}
    with duckdb.connect() as connection:
        connection.execute("CREATE MACRO number(name) AS right(name, 1)::INTEGER")
        views_over(connection, *tables, planted=TABLE.sub(r"\1 stored_\2", sql))
        return run_audits(connection, [AUDITS[name] for name in names], chosen)


@pytest.fixture(scope="module")
def statuses(clean: Tables) -> dict[str, str]:
    """Return the status on clean data of every audit that needs only a store."""
    alone = [audit.name for audit in AUDITS.values() if audit.needs is None]
    return {one.audit.name: one.status for one in findings_of(clean, alone)}


STRICTER = {  # thresholds that suit the small synthetic data
    "stratum_of_failures": {"min_success_share": 0.01},
    "thin_perturbation": {"min_rows": 1},
}
# In the synthetic data action residuals are random, recordings overlap in time, and there are no
# action probabilities.
NOT_CLEAN = {"far_actions", "overlapping_recordings", "no_action_probability"}
# faults that test_reward_audit, test_exposure_strata and test_compaction plant
ELSEWHERE = {"reward_undetermined", "chosen_on_outcome", "many_small_files"}


@pytest.mark.parametrize(
    ("name", "rows", "first", "sql"), FAULTS, ids=[name for name, *_ in FAULTS]
)
def test_audit_finds_planted_fault(clean, statuses, name, rows, first, sql):
    assert statuses[name] == "pass" or name in NOT_CLEAN
    (finding,) = findings_of(clean, [name], sql, **STRICTER.get(name, {}))
    assert finding.rows == rows
    expected = {"error": "fail", "warning": "warn", "info": "info"}[AUDITS[name].severity]
    assert finding.status == expected
    assert first.items() <= finding.sample[0].items()


def test_every_store_audit_has_planted_fault():
    alone = {name for name, audit in AUDITS.items() if audit.needs is None}
    assert {name for name, *_ in FAULTS} | ELSEWHERE == alone


def finding_on(store: Path, name: str, spoil: str = "SELECT 1", **places: Path) -> Finding:
    """Return an audit's finding on a panel or run after the SQL `spoil` has changed its tables."""
    chosen = {name: load_thresholds()[name]} if AUDITS[name].parameters else {}
    with open_place(store, beside=places) as connection:
        install_named(connection, spoil)
        connection.execute(spoil).fetchall()
        return run_audits(connection, [AUDITS[name]], chosen, beside=[*places])[0]


def write_run(path: Path, **tables: list[dict[str, Any]]) -> Path:
    """Write the parts of a run directory that audits read."""
    path.mkdir(exist_ok=True)
    (path / "config.json").write_text("{}")
    for name, rows in tables.items():
        pq.write_table(pa.Table.from_pylist(rows), path / f"{name}.parquet")
    return path


def test_bias_of_easy_evaluation_is_found(tmp_path):
    # Half of the logged episodes are nominal, but nine tenths of those evaluated, and the policy
    # succeeds in these. Only the last evaluation counts.
    table = recording_transitions(1, episodes=40)
    truth = np.where(table["episode_index"].to_numpy() % 2 == 0, "nominal", "blocked_aisle")
    store = write_store(tmp_path / "store", [replaced(table, {"true_condition": truth.tolist()})])
    rows = [
        {"env_steps": steps, "condition": condition, "success": condition == "nominal"}
        for steps in (100, 200)
        for condition in ["nominal"] * (9 if steps == 200 else 1) + ["blocked_aisle"]
    ]
    biased = finding_on(store, "evaluation_bias", run=write_run(tmp_path / "run", evaluations=rows))
    expected = {"share": 0.9, "share_in_logs": 0.5, "success_share": 1.0}
    assert biased.sample == [{"condition": "nominal"} | expected]
    assert finding_on(store, "evaluation_bias").status == "skipped"
    # If the policy succeeds everywhere, the share of a condition biases nothing.
    rows = [row | {"success": True} for row in rows]
    run = write_run(tmp_path / "run", evaluations=rows)
    assert finding_on(store, "evaluation_bias", run=run).rows == 0


@pytest.fixture(scope="module")
def panels(store_path, tmp_path_factory) -> dict[str, Path]:
    """Return one panel of the store per kind of evaluation split."""
    folder = tmp_path_factory.mktemp("panels")
    text = (
        "evaluation_split = {{by = '{}'}}\nplanned_draws = 6400\n"
        "correction = {{post = 'none'}}\n[each_condition]\nshare = 'equal'"
    )
    return {
        by: panel_of(store_path, text.format(by), folder / by).path
        for by in ("episode", "recording", "time")
    }


def test_overrepresented_strata_are_found(store_path, panels):
    finding = finding_on(store_path, "panel_bias", panel=panels["episode"])
    boosted = {row["stratum"] for row in finding.sample}
    assert boosted == {"wheel_slip", "blocked_aisle", "near_collision", "recovery"}


ELSEWHERE_BUT = "SELECT * REPLACE ('elsewhere' AS episode_id) FROM panel.rows "
LEAKS = {  # split -> leak reported, SQL of a row that is held out although it is in the panel
    "episode": ("the same episode", "SELECT * FROM panel.rows LIMIT 1"),
    "recording": ("a recording that is held out", ELSEWHERE_BUT + "LIMIT 1"),
    "time": ("later than what is held out", ELSEWHERE_BUT + "ORDER BY logged_ns LIMIT 1"),
}
HELD_OUT = "CREATE OR REPLACE VIEW panel.evaluation_split AS SELECT *, '{}' AS split_by FROM {}"


@pytest.mark.parametrize("by", LEAKS)
def test_leak_from_evaluation_split_is_found(store_path, panels, by):
    leak, spoilt = LEAKS[by]
    assert finding_on(store_path, "leakage", panel=panels[by]).status == "pass"
    spoil = HELD_OUT.format(by, f"({spoilt})")
    finding = finding_on(store_path, "leakage", spoil, panel=panels[by])
    assert finding.status == "fail"
    assert leak in {row["leak"] for row in finding.sample}


def test_copy_of_held_out_step_is_leak(tmp_path):
    table, name = recording_transitions(1), f"{7:016x}"
    copied = {
        "recording_id": [name] * len(table),
        "episode_id": [f"{name}/{index}" for index in table["episode_index"].to_pylist()],
        "transition_id": (np.int64(7) << 25) + np.arange(len(table)),
        "ingest_id": ["copy"] * len(table),
    }
    path = write_store(tmp_path / "store", [table, replaced(table, copied)])
    # A panel leaves out such copies itself, so it is built from a store without the copy.
    mixture = "[each_condition]\n[evaluation_split]\nby = 'none'"
    panel = panel_of(write_store(tmp_path / "alone", [table]), mixture, tmp_path / "p")
    spoil = HELD_OUT.format("recording", f"transitions WHERE recording_id = '{name}'")
    finding = finding_on(path, "leakage", spoil, panel=panel.path)
    assert {row["leak"] for row in finding.sample} == {"the same step under another id"}
    assert finding.rows == len(table["episode_id"].unique())


def test_strata_with_few_episodes_are_found(store_path, panels, tmp_path):
    panel = panels["episode"]
    assert finding_on(store_path, "few_panel_episodes", panel=panel).status == "pass"
    spoil = "UPDATE panel.strata SET effective_episodes = 2.5 WHERE name = 'wheel_slip'"
    finding = finding_on(store_path, "few_panel_episodes", spoil, panel=panel)
    assert [row["stratum"] for row in finding.sample] == ["wheel_slip"]

    older = write_run(tmp_path / "run", evaluations=[{"condition": "nominal"}])
    assert finding_on(store_path, "few_drawn_episodes", run=older).status == "skipped"
    drawn = [("nominal", index, 10) for index in range(20)]
    drawn += [("wheel_slip", index, count) for index, count in ((0, 500), (1, 3), (2, 3))]
    rows = [
        {"source": "logs", "stratum": stratum, "episode": f"{1:016x}/{index}", "drawn_rows": count}
        for stratum, index, count in drawn
    ]
    run = write_run(tmp_path / "run", sampled_episodes=rows)
    (row,) = finding_on(store_path, "few_drawn_episodes", run=run).sample
    assert (row["stratum"], row["episodes"]) == ("wheel_slip", 3)
    assert row["effective_episodes"] == pytest.approx(1.02, abs=0.01)


def test_custom_audits_and_thresholds(tmp_path, clean):
    (tmp_path / "slow.sql").write_text(
        "-- severity: error\n-- advice: Drive on.\n-- doc: Slow steps.\n"
        "SELECT transition_id FROM transitions WHERE command_speed_mps < $least LIMIT 3"
    )
    (tmp_path / "rare_condition.sql").write_text(
        "-- severity: info\n-- advice: None.\n-- doc: Nothing.\nSELECT 1 WHERE false"
    )
    audits = {audit.name: audit for audit in load_audits(tmp_path)}
    assert audits["rare_condition"].severity == "info"
    assert audits.keys() == AUDITS.keys() | {"slow"}
    (tmp_path / "mine.toml").write_text("[slow]\nleast = 0.5\n[stale_data]\nmax_age_days = 7")
    thresholds = load_thresholds(tmp_path / "mine.toml")
    assert thresholds["stale_data"] == {"max_age_days": 7}
    broken = Audit("broken", "error", "", "", None, "SELECT nothing FROM transitions")
    with duckdb.connect() as connection:
        views_over(connection, *clean)
        (finding,) = run_audits(connection, [audits["slow"]], {"slow": thresholds["slow"]})
        assert (finding.status, finding.rows) == ("fail", 3)
        for audit, given, place in (
            ("slow", {}, "slow"),  # no threshold least
            ("slow", {"slow": {"least": 1, "most": 2}}, r"slow\.most"),
            ("slow", {"flattering_policy": {}}, "'policy_bias'"),  # its new name
            ("slow", {"slow": {"max_flattery": 1}}, "'max_bias'"),
            ("slow", {"sloow": {"least": 1}}, "'sloow'"),
            ("broken", {}, "broken"),
        ):
            with pytest.raises(ConfigError, match=place):
                run_audits(connection, [(audits | {"broken": broken})[audit]], given)


@pytest.mark.parametrize(
    "text",
    [
        "-- severity: error\n-- doc: x\nSELECT 1",  # no advice
        "-- severity: bad\n-- advice: x\n-- doc: x\nSELECT 1",
        None,  # a folder without audits
    ],
)
def test_invalid_audit_files_are_refused(tmp_path, text):
    if text is not None:
        (tmp_path / "mine.sql").write_text(text)
    with pytest.raises(ConfigError) as refused:
        load_audits(tmp_path)
    assert str(refused.value.where) == str(tmp_path / "mine.sql" if text else tmp_path)


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("rare_condition = 3", "rare_condition"),
        ("stale_data.max_age_days = 'x'", "stale_data.max_age_days"),
        ("stale_data.max_age_days = nan", "stale_data.max_age_days"),  # no row would be above it
        ("[rare", "t.toml"),
        (None, "t.toml"),
    ],
)
def test_invalid_threshold_files_are_refused(tmp_path, text, place):
    if text is not None:
        (tmp_path / "t.toml").write_text(text)
    with pytest.raises(ConfigError, match=re.escape(place)):
        load_thresholds(tmp_path / "t.toml")


def test_shipped_thresholds_match_audit_parameters():
    shipped = load_thresholds()
    assert {name: set(table) for name, table in shipped.items()} == {
        name: audit.parameters for name, audit in AUDITS.items() if audit.parameters
    }


@pytest.mark.long
def test_findings_do_not_depend_on_cached_tables(tmp_path, monkeypatch):
    writer = StoreWriter(tmp_path / "store")
    written = [recording_transitions(number) for number in (1, 2, 3)]
    for rows in written:
        writer.write(manifest(rows), rows)
    kept: dict[tuple[int, int], list[str]] = {}

    def findings(rows: int, summarised_rows: int) -> list[tuple[str, str, int]]:
        """Return audit, status and row count if tables of at most so many rows are cached."""
        monkeypatch.setattr(definitions, "FEW_ROWS", rows)
        monkeypatch.setattr(definitions, "FEW_SUMMARISED_ROWS", summarised_rows)
        tables: list[str] = []

        def note(_: str) -> None:
            held = store.bare.sql("SELECT table_name FROM duckdb_tables()").fetchall()
            tables[:] = {"transitions", "stored_summaries"}.intersection(name for (name,) in held)

        with Store(tmp_path / "store") as store:
            found = run_audits(store.connection, shipped_audits(), load_thresholds(), done=note)
            kept[rows, summarised_rows] = sorted(tables)
            note("")
            assert not tables
            counted = store.sql("SELECT count(reward) FROM transitions").fetchall()
            assert counted == [(sum(map(len, written)),)]  # from the files again
        return [(one.audit.name, one.status, one.rows) for one in found]

    nothing = findings(0, 0)
    assert sum(bool(rows) for *_, rows in nothing) > 5
    assert findings(0, 10**6) == findings(10**6, 10**6) == nothing
    assert kept == {
        (0, 0): [],
        (0, 10**6): ["stored_summaries"],
        (10**6, 10**6): ["stored_summaries", "transitions"],
    }


def test_audit_verb_fails_only_on_errors(store_path, tmp_path, shell):
    junit, audit = tmp_path / "audit.xml", ["audit", str(store_path)]
    document = shell.json(*audit, "--junit", junit, code=1)
    assert document["failed"] == 1
    assert [a["audit"] for a in document["audits"] if a["status"] == "fail"] == ["rare_condition"]
    (root,) = ElementTree.fromstring(junit.read_text())
    failed = [case.get("name") for case in root if case.find("failure") is not None]
    assert failed == ["rare_condition"]
    assert root.get("tests") == str(len(AUDITS))
    (tmp_path / "easy.toml").write_text("[rare_condition]\nmin_rows = 1\nmin_episodes = 1")
    easy = [*audit, "--thresholds", str(tmp_path / "easy.toml")]
    out = shell.out(*easy)
    assert "stale_data" in out
    assert "skipped" in out
    assert cli.main([*easy, "--strict", "--junit", str(junit)]) == 1
    assert int(ElementTree.fromstring(junit.read_text())[0].get("failures", "")) > 0


def test_invalid_audit_arguments_exit_2(store_path, panels, tmp_path, shell):
    lost, rows = tmp_path / "lost", recording_transitions(1)
    StoreWriter(lost).write(manifest(rows), rows)
    for file in (lost / "transitions").rglob("*.parquet"):
        file.unlink()
    assert cli.main(["store", "compact", str(lost), "--drop-damaged"]) == 3
    other = write_store(tmp_path / "other", [recording_transitions(4)])
    drawn = {"source": "logs", "stratum": "a", "episode": f"{1:016x}/0", "drawn_rows": 1}
    rows = [drawn, drawn | {"source": "fresh", "episode": "7"}]
    run = write_run(tmp_path / "run", sampled_episodes=rows)
    (tmp_path / "file").touch()
    for place, words, named in (
        (tmp_path, [], tmp_path),  # no store
        (lost, [], lost),  # without rows
        (lost, ["--reward"], lost),
        (store_path, [panels["time"], panels["time"]], panels["time"]),  # two panels
        (store_path, ["--junit", tmp_path / "file" / "x.xml"], tmp_path / "file"),
        (other, [panels["time"]], panels["time"]),  # made from another store
        (other, [run], run),
    ):
        assert str(named) in "".join(shell.err("audit", place, *words).split())
    moved = shutil.copytree(store_path, tmp_path / "moved")
    with open_place(moved, beside={"panel": panels["time"], "run": run}):
        pass


def test_panel_of_partly_other_store_fails(store_path, panels, tmp_path):
    name, panel = "panel_of_another_store", panels["time"]
    assert finding_on(store_path, name, panel=panel).status == "pass"
    part = write_store(tmp_path / "part", [recording_transitions(1), recording_transitions(4)])
    finding = finding_on(part, name, panel=panel)
    assert finding.status == "fail"
    held = Panel.open(panel).meta["recording_id"].to_pylist()
    assert finding.sample == [
        {"recording_id": one, "missing_rows": held.count(one), "panel_recordings": len(set(held))}
        for one in sorted(set(held) - {f"{1:016x}"})
    ]
    # Rows from the mixture's other stores are not expected in this one.
    others = "CREATE OR REPLACE TABLE panel.strata AS SELECT * REPLACE ('b' AS source)"
    assert finding_on(part, name, f"{others} FROM panel.strata", panel=panel).status == "pass"


def test_junit_file_follows_schema():
    """Check junit-10.xsd's rules on element names, attributes and counts."""
    rows = [{"source_file": "a\x00b\x1b[31m\ud800<&>", "rows": 3}]
    findings = [
        Finding(AUDITS["rare_condition"], "fail", 3, ["rows"], rows, {}),
        Finding(AUDITS["stale_data"], "warn", 1, ["rows"], rows, {}),
        Finding(AUDITS["several_tasks"], "pass", 0, [], [], {}),
        Finding(AUDITS["leakage"], "skipped", 0, [], [], {}),
    ]
    text = junit_suites({"audit \x07 store": findings}, {"fail"})
    (root,) = ElementTree.fromstring(text.encode("utf-8"))  # fails on characters that XML forbids
    assert root.tag == "testsuite"
    assert root.keys() == ["name", "tests", "failures", "errors", "skipped"]
    assert [root.get(name) for name in ("tests", "failures", "errors", "skipped")] == list("4101")
    for case in root:
        assert case.tag == "testcase"
        assert {"name", "classname"} == set(case.keys())
        assert {child.tag for child in case} <= {"failure", "skipped", "system-out"}
    failure = root[0].find("failure")
    assert failure is not None
    assert "<&>" in str(failure.text)
    assert root[1].find("failure") is None
    assert root[3].find("skipped") is not None
