"""The colours of all pages: one for each condition, and the dark page's for the light one's."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence

from restock.report.look.blocks import words
from restock.train.twin.missions import MISSIONS

# Okabe-Ito: colour-blind readers can distinguish them too.
CONDITION_COLOURS = {
    **{name: one.colour for name, one in MISSIONS.items()},
    **{
        f"{name} ({block})": colour
        for name, one in MISSIONS.items()
        for block, colour in one.blocks.items()
    },
    "recovery": "#cc79a7",
}
WORDS_COLOURS = {words(name): colour for name, colour in CONDITION_COLOURS.items()}
SPARE_COLOURS = ("#56b4e9", "#009e73", "#8b5cf6", "#84643a", "#111827")


def palette(
    names: Collection[str],
    colours: Mapping[str, str] = CONDITION_COLOURS,
    spare: Sequence[str] = SPARE_COLOURS,
) -> dict[str, str]:
    """Return a colour for each name, independent of their order.

    A name gets its own colour, else the first free spare one. The search begins at the same place
    in every chart.
    """
    found = {name: colours[name] for name in names if name in colours}
    free: list[str] = []
    for name in sorted(set(names) - set(found)):
        free = free or list(spare)
        first = sum(map(ord, words(name))) % len(spare)
        likes = (*spare[first:], *spare[:first])
        found[name] = next(colour for colour in likes if colour in free)
        free.remove(found[name])
    return found


DARK = {
    # ink, rules and grounds
    "#0f172a": "#e8edf4",
    "#334155": "#cbd5e1",
    "#475569": "#a3b1c6",
    "#64748b": "#94a3b8",
    "#94a3b8": "#7b8aa3",
    "#cbd5e1": "#475569",
    "#e2e8f0": "#2b3a52",
    "#f8fafc": "#101a2d",
    "#ffffff": "#16213a",
    # series
    "#111827": "#e5e7eb",
    "#6b7280": "#a1a8b5",
    "#9ca3af": "#7f8795",
    "#0f766e": "#2dd4bf",
    "#14b8a6": "#2ac7b4",
    "#0072b2": "#4aa8e8",
    "#8a5a00": "#c08a2d",
    "#d55e00": "#f3843a",
    "#b45309": "#f59a4a",
    "#7c3aed": "#c79bff",
    "#8b5cf6": "#a88bfa",
    "#84643a": "#c2a06b",
    "#009e73": "#2fc79a",
    "#b91c1c": "#f87171",
    "#2563eb": "#6ea0ff",
    "#be185d": "#f472b6",
    "#b58900": "#e8d44d",
    "#7f1d1d": "#e06a6a",
    "#0c98dd": "#7dd3fc",
}


def dark_rules() -> str:
    """Return the CSS rules that exchange a figure's colours in the dark theme."""
    return "\n".join(_rules())


def _rules() -> Iterator[str]:
    for light, dark in DARK.items():
        for part in ("fill", "stroke"):
            yield f'  svg [{part}="{light}"] {{ {part}: {dark}; }}'
        yield f'  .swatch[style*="{light}"] {{ background: {dark} !important; }}'
