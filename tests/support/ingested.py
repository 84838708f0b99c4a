"""What becomes of a bag: a proposed profile, steps, and a store of its rows."""

from pathlib import Path
from typing import Any

from restock.cli import main
from restock.ingest.containers.open_recording import open_recording
from restock.ingest.profile.profile import Profile, load_profile, parse_profile
from restock.ingest.steps.episodes import Steps, steps_of
from restock.ingest.steps.needs import read_topics
from restock.replay.store.store import Store


def proposed(bag: Path, file: Path, *options: str, codes: tuple[int, ...] = (0,)) -> Profile:
    """Write the proposal of `restock profile new` to a file, and load it."""
    assert main(["profile", "new", str(bag), "--out", str(file), *options]) in codes
    return load_profile(file)


def steps_in(bag: Path, profile: Profile | str) -> Steps:
    """Return the steps of a bag by a profile, or by the text of one."""
    if isinstance(profile, str):
        profile = parse_profile(profile, where="p.toml")
    with open_recording(bag) as recording:
        return steps_of(profile, read_topics(recording, profile))


def ingested(bag: Path, profile: Path | str, store: Path) -> Store:
    """Ingest a bag by `restock ingest`, and open the store."""
    assert main(["ingest", str(bag), "--profile", str(profile), "--store", str(store)]) == 0
    return Store(store)


def queried(store: Path, query: str) -> list[tuple[Any, ...]]:
    """Return the rows that a store answers."""
    with Store(store) as opened:
        return opened.sql(query).fetchall()
