"""The robot of a store's logs is that of its profile, even after only [robot] changed."""

from pathlib import Path

from support.paths import ROOT

from restock.ingest.pipeline import ingest
from restock.ingest.profile.profile import load_profile, parse_profile, profile_toml
from restock.ingest.store.writer import StoreWriter
from restock.replay.store.store import Store
from restock.train.twin.calibration.logged_steps import robot_of_store


def test_a_changed_robot_reaches_the_store_without_reading_again(tmp_path: Path) -> None:
    text = profile_toml(load_profile("warehouse_amr"))
    writer = StoreWriter(tmp_path / "store")
    kept = []
    for table in ("", "\n[robot]\nmass_kg = 40.0\n", "\n[robot]\nmass_kg = 45.0\n"):
        profile = parse_profile(text + table, where="here")
        outcome = ingest(ROOT / "sample_logs" / "amr_tuesday", profile, store=writer)
        with Store(tmp_path / "store") as store:
            robot = robot_of_store(store, profile.task.hash)
        kept.append((outcome.status, robot.mass_kg if robot else None))
    assert kept[0][1] is None
    assert kept[1:] == [("tagged", 40.0), ("tagged", 45.0)]
