"""Texts of profiles, for tests that change a word of one."""

from support.paths import ROOT

WAREHOUSE = (ROOT / "ingest" / "profile" / "profiles" / "warehouse_amr.toml").read_text("utf-8")


def framed(text: str = WAREHOUSE, frames: str = "[frames]\n\n[clock]") -> str:
    """Return the profile without a pose topic: its poses come from transforms."""
    start, end = text.index("[inputs.pose]"), text.index("[inputs.wheels]")
    return (text[:start] + text[end:]).replace("[clock]", frames, 1)
