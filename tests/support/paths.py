"""Where the project and the shared recordings are."""

import json
from pathlib import Path

ROOT = Path(__file__).parents[2]
SHARED = ROOT.parent / "shared" / "bags"  # recordings that other people made; tests skip without


def sample_transitions(name: str) -> int:
    """How many transitions a recording of sample_logs/ has, by its manifest."""
    manifest = json.loads((ROOT / "sample_logs" / "manifest.json").read_text(encoding="utf-8"))
    return sum(manifest["recorded"][name]["policy_steps"].values())
