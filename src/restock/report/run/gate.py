"""The page of a gate: the claim, its evidence, and what it is not about."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import altair as alt

from restock.report.look.blocks import Drawing, Figure, Section, Table, count, words
from restock.report.look.charts import FULL, draw, label_px, plot, side_by_side
from restock.stats import interval_text
from restock.train.judge.sequential import NOT_SHOWN, NOT_WORSE, WORSE

_KINDS = {NOT_WORSE: "good", NOT_SHOWN: "open", WORSE: "bad"}
_WORDS = {NOT_WORSE: "shown not worse", NOT_SHOWN: "not shown", WORSE: "shown worse"}
_COLOURS = {NOT_WORSE: "#0f766e", NOT_SHOWN: "#b58900", WORSE: "#be185d"}
HEIGHT = 150


def gate_page(document: dict[str, Any]) -> dict[str, Any]:
    """Return everything that the page's template needs."""
    cells, policy = document["cells"], document["policy"]
    of = {word: sum(cell["verdict"] == word for cell in cells) for word in _WORDS}
    return {
        "kicker": "gate",
        "title": f"May {Path(document['run']).name} drive instead of {document['baseline']}?",
        "verdict": {"kind": _KINDS[document["verdict"]], "text": _WORDS[document["verdict"]]},
        "headline": document["claim"][0].upper() + document["claim"][1:],
        "lead": ("" if policy is None else f"{policy['text'].capitalize()}. ")
        + "Both drove the same missions in the twin, until each condition was decided or its budget"
        f" of {count(document['budget'])} pairs was spent.",
        "cards": [
            {"value": count(number), "label": f"of {len(cells)} tests: {_WORDS[word]}"}
            for word, number in of.items()
        ],
        "sections": [_evidence(cells), _limits(document)],
    }


def _evidence(cells: list[dict[str, Any]]) -> Section:
    floors = {cell["layouts"] for cell in cells}
    rows = [
        {
            "test": cell["name"],
            **({"floors": cell["layouts"]} if len(floors) > 1 else {}),
            "verdict": _WORDS[cell["verdict"]],
            "better by": "nothing compared"
            if cell["difference"] is None
            else interval_text(cell["difference"], cell["low"], cell["high"], "+.3f"),
            "margin": f"{cell['margin']:g} {cell['unit']}".strip(),
            "pairs": count(cell["pairs"]),
        }
        for cell in cells
    ]
    by_measure: dict[str, list[dict[str, Any]]] = {}
    for cell in cells:
        if cell["curve"]:
            by_measure.setdefault(cell["measure"], []).append(cell)
    figures = [
        Figure(
            _curves(of, several_floors=len(floors) > 1),
            f"{words(measure).capitalize()}: by how much the policy was better",
            "The bounds after each pair hold at every moment. The policy is shown not to be worse"
            " once the lower one is above the dashed line, the margin.",
            name=f"bounds of {words(measure)}",
        )
        for measure, of in by_measure.items()
    ]
    return Section("evidence", "Evidence", figures=figures, tables=[Table(rows)])


def _curves(cells: list[dict[str, Any]], *, several_floors: bool) -> Drawing:
    """Draw the bounds of each cell by pairs, with its margin."""
    rows = [
        {
            "cell": cell["name"] + (f", {cell['layouts']}" if several_floors else ""),
            "limit": -cell["margin"],
            "verdict": cell["verdict"],
            **point,
        }
        for cell in cells
        for point in cell["curve"]
    ]
    names = list(dict.fromkeys(row["cell"] for row in rows))
    colour = alt.Color(
        "verdict:N",
        legend=None,
        scale=alt.Scale(domain=list(_COLOURS), range=list(_COLOURS.values())),
    )
    ends = [4 * cell["margin"] for cell in cells]
    shown = alt.Scale(domain=[-max(ends), max(ends)], clamp=True)
    percent = alt.Axis(format="+.0%") if cells[0]["unit"] == "" else alt.Axis(format="~g")

    def chart(width: int) -> Any:
        base = plot(rows).encode(x=alt.X("pairs:Q", title="pairs of episodes"))
        area = base.mark_area(opacity=0.3).encode(
            y=alt.Y("low:Q", title=None, axis=percent, scale=shown), y2="high:Q", color=colour
        )
        line = base.mark_line(strokeWidth=2).encode(y=alt.Y("low:Q", scale=shown), color=colour)
        limit = base.mark_line(strokeDash=[4, 3], color="#0f172a").encode(
            y=alt.Y("limit:Q", scale=shown)
        )
        layered = alt.layer(area, line, limit).properties(height=HEIGHT)
        return side_by_side(layered, "cell", names, width, label_px(["+20%"]))

    return draw(chart, FULL)


def _limits(document: dict[str, Any]) -> Section:
    rows = [{"limit": line} for line in document["limits"]]
    return Section("limits", "What this does not say", tables=[Table(rows)])
