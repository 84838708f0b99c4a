"""Check custom profiles, whose text the store, the panel and the run carry.

Conditions over custom signals label logs, not the twin, which has no such signals.
"""

import json
from pathlib import Path

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.paths import ROOT
from support.profile_texts import WAREHOUSE

from restock.cli import main
from restock.errors import ConfigError, PanelError
from restock.ingest.profile.profile import load_profile, parse_profile, profile_toml
from restock.ingest.profile.tables import CustomSignal
from restock.replay.panel.panel import Panel
from restock.replay.store.store import Store
from restock.train.prepare import prepare_new, prepare_resumed
from restock.train.run.run import Run
from restock.train.run.run_profile import profile_of_panel, profile_of_run

AMR = load_profile("warehouse_amr")
SHORTER = WAREHOUSE.replace("time_limit_steps = 240", "time_limit_steps = 60")  # another task
OWN = """
[[condition]]
file = "creeping.sql"

[[condition]]
name = "sagging"
timing = "pre"
priority = 30
sql = "battery_v < 26.395"

[signals.battery_v]
topic = "/diagnostics"
type = "diagnostic_msgs/msg/DiagnosticArray"
path = "status[name=battery].values[key=voltage].value"
unit = "V"
"""
CREEPING = """-- timing: pre
-- priority: 35
abs(wheel_speed_mps) < 0.3
"""
TINY = [
    *("schedule.env_steps=400", "schedule.offline_updates=5", "schedule.warmup_env_steps=40"),
    *("env.num_envs=4", "evaluation.episodes=1", "evaluation.every_env_steps=400"),
    *("record.trackers=[]", "network.hidden=[8]", "replay.batch_size=16"),
    "env.conditions={nominal=1.0}",
]
FLAGS = [word for text in TINY for word in ("--set", text)]
TUESDAY, MONDAY = str(ROOT / "sample_logs/amr_tuesday"), str(ROOT / "sample_logs/amr_monday.mcap")


def ingest_with_profile(folder: Path, name: str, recording: str, store: Path) -> None:
    """Ingest with a profile of this name, then delete the profile's files."""
    profile = folder / f"{name}.toml"
    profile.write_text(SHORTER.replace('name = "warehouse_amr"', f'name = "{name}"', 1) + OWN)
    (folder / "creeping.sql").write_text(CREEPING)
    assert main(["ingest", recording, "--profile", str(profile), "--store", str(store)]) == 0
    profile.unlink()
    (folder / "creeping.sql").unlink()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of a store, its panel and a run, made with a profile that was deleted."""
    folder = tmp_path_factory.mktemp("carried")
    ingest_with_profile(folder, "mine", TUESDAY, folder / "store")
    assert main(["mix", str(folder / "store"), "--out", str(folder / "panel")]) == 0
    given = ["--panel", str(folder / "panel"), "--out", str(folder / "run")]
    assert main(["train", *given, *FLAGS]) == 0
    return folder


def panel_with_profile(folder: Path, text: str) -> Panel:
    """Return the folder's panel with this profile text."""
    panel = Panel.open(folder / "panel")
    header = msgspec.structs.replace(panel.header, profile_toml=text)
    return Panel(panel.path, header, panel.rows)


def test_store_panel_and_run_carry_the_profile_text(folder: Path) -> None:
    with Store(folder / "store") as store:
        rows = store.sql("SELECT profile_toml, profile_hash FROM recordings").fetchall()
    carried = parse_profile(rows[0][0], where="test")
    assert (carried.name, carried.hash) == ("mine", rows[0][1])
    rules = ["abs(wheel_speed_mps) < 0.3", "battery_v < 26.395"]
    assert [c.sql for c in carried.own_conditions] == rules
    assert profile_of_panel(Panel.open(folder / "panel")) == carried
    run = Run.open(folder / "run")
    assert profile_of_run(run) == carried
    assert run.document["config"]["profile"] == "mine"


def test_eval_and_resume_work_without_profile_file(folder, shell):
    drive = ["eval", str(folder / "run"), "--episodes", "nominal=1", "--perturbations", "none"]
    assert shell.json(*drive, "--policies", "agent")["results"]
    assert main(["report", str(folder / "run")]) == 0
    page = (folder / "run" / "report.html").read_text()
    assert "Conditions of the logs that the twin cannot show" in page
    assert "battery_v" in page
    resumed = prepare_resumed(folder / "run", ["schedule.env_steps=410"])
    assert resumed.profile.name == "mine"
    # The settings of the run's config reproduce it with the panel's profile.
    again = prepare_new(folder / "again", folder / "panel", None, [*TINY, "profile=mine"])
    assert again.profile == resumed.profile


def test_run_lists_conditions_the_twin_cannot_show(folder, shell):
    """Evaluate conditions of twin signals in the twin; logs keep their stored labels."""
    line = ["train", "--panel", str(folder / "panel"), "--out", str(folder / "dry"), *FLAGS]
    out, err = shell.printed(*line, "--dry-run")
    assert err.count("condition 'sagging' is not evaluated in the twin") == 1
    assert json.loads(out)["not_evaluated"] == {"sagging": ["battery_v"]}
    assert not (folder / "dry").exists()
    run = Run.open(folder / "run")
    assert run.document["not_evaluated"] == {"sagging": ["battery_v"]}
    labels = {name for names in run.table("episodes")["conditions"].to_pylist() for name in names}
    assert "creeping" in labels
    assert "sagging" not in labels
    observed = run.table("conditions").to_pylist()
    assert {row["source"] for row in observed if row["condition"] == "sagging"} == {"logs"}


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("[[condition]]\nfile = 'other.sql'", "needs a profile that is a file"),
        (
            "[[condition]]\nname = 'reads'\ntiming = 'pre'\n"
            "sql = \"EXISTS (FROM read_text('/etc/hostname'))\"",
            "reads",
        ),
        ("x = " + "[" * 100_000, "nested more than 64 levels deep"),
        ("unknown = 1\n", "unknown"),
    ],
)
def test_carried_profile_is_as_restricted_as_a_file(folder, text, problem):
    whole = profile_toml(AMR).replace("condition = []\n", "")
    text = whole + text if "[[" in text else text + whole
    with pytest.raises(ConfigError, match=problem):
        parse_profile(text, where="a panel")
    with pytest.raises(PanelError, match=r"that it contains cannot be read") as error:
        profile_of_panel(panel_with_profile(folder, text))
    assert error.value.remedy is not None
    assert "--set profile=mine.toml" in error.value.remedy


@settings(max_examples=12)
@given(
    doc=st.text(),
    age_s=st.one_of(st.none(), st.floats(1e-9, 1e9)),
    values=st.dictionaries(st.text(), st.floats(allow_nan=False, allow_infinity=False)),
)
def test_profile_text_round_trips(doc, age_s, values):
    signal = CustomSignal("/a", "a/msg/B", "data", "V", max_age_s=age_s, values=values, doc=doc)
    profile = msgspec.structs.replace(AMR, signals={"voltage_v": signal}, doc=doc)
    assert parse_profile(profile_toml(profile), where="test") == profile
