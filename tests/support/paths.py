"""Where the project and the shared recordings are."""

from functools import cache
from pathlib import Path

from restock.ingest.pipeline import ingest
from restock.ingest.profile.profile import load_profile

ROOT = Path(__file__).parents[2]
SHARED = ROOT.parent / "shared" / "bags"  # recordings that other people made; tests skip without


@cache
def sample_transitions(name: str) -> int:
    """How many transitions a recording of sample_logs/ has, by the shipped profile."""
    recording = ROOT / "sample_logs" / name
    made = ingest(recording, load_profile("warehouse_amr"), store=None)
    return int(made.manifest["transitions"])
