"""Light and dark: one set of colours, and what each becomes on a dark ground.

Figures are drawn in the colours of the light page. The style sheet exchanges them on a screen that
prefers dark; what is printed, and figures written as files, stay light.
"""

from __future__ import annotations

from collections.abc import Iterator

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


__all__ = ["DARK", "dark_rules"]
