"""Where the project and the shared recordings are."""

from pathlib import Path

ROOT = Path(__file__).parents[2]
SHARED = ROOT.parent / "shared" / "bags"  # recordings that other people made; tests skip without
