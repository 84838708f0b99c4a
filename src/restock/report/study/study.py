"""A study as a page: the gate's verdicts first, then its one contrast, its arms and comparisons."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from restock import __version__
from restock.report.look.blocks import Figure, Rows, Section, Table, words
from restock.report.study import charts
from restock.report.study.comparison import (
    cost_cards,
    curves_section,
    headline,
    outcome_sections,
    why_refused,
)
from restock.stats import MIN_PAIRS, interval_text, no_interval_text, which_adjusted

SAFETY = {
    "bumps_per_km": ("bumps per km", ".1f"),
    "closest_person_m": ("closest person, m", ".2f"),
    "time_lost_s": ("time lost, s", "+.1f"),
    "discounted_return": ("discounted return", ".2f"),
}


def study_page(study: dict[str, Any], name: str = "") -> dict[str, Any]:
    """Return everything that the template needs, from a study's findings (`study.json`)."""
    comparisons = study["comparisons"]
    refused = [one for one in comparisons if one["verdict"] != "comparable"]
    arms = list(study["runs"])
    sections = [
        _gate(comparisons),
        _contrasts(study["contrasts"], study["rare"]),
        _arms(study["arms"], arms),
        curves_section(study.get("curves", []), arms),
        *(
            section
            for number, one in enumerate(comparisons)
            for section in outcome_sections(one, one["baseline"], one["arm"], f"c{number}-")
        ),
    ]
    total = len(comparisons)
    return {
        "kicker": "study",
        "title": f"Study {name or ', '.join(arms)}",
        "verdict": {
            "kind": "good" if not refused else "bad" if len(refused) == total else "open",
            "text": f"gate passed: {total} of {total} comparisons"
            if not refused
            else f"gate refused {len(refused)} of {total} comparisons",
        },
        "headline": _headline(study),
        "lead": (f"{study['doc']} " if study["doc"] else "")
        + f"{len(arms)} arms, seeds {', '.join(map(str, study['seeds']))}, all evaluated on the"
        " same episodes.",
        "cards": cost_cards(study.get("cost", [])),
        "sections": [section for section in sections if section is not None],
        "footer": f"restock {__version__} · written {datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
    }


def _headline(study: dict[str, Any]) -> str:
    """Return the contrast that the study is for, else its first comparison."""
    primary = next((row for row in study["contrasts"] if row["primary"]), None)
    if primary is None:
        one = study["comparisons"][0]
        return headline(one, one["baseline"], one["arm"])
    value = f"{100 * primary['difference']:+.1f} points".replace("-", "−")
    pair = f"{primary['arm']} against {primary['baseline']} in {_measure(primary['measure'])}"
    if primary["low"] is None:
        return f"{pair}: {value}{no_interval_text(primary.get('no_interval'))}"
    ends = [f"{100 * primary[end]:+.1f}".replace("-", "−") for end in ("low", "high")]
    shown = "a difference" if primary["low"] > 0 or primary["high"] < 0 else "no difference shown"
    return f"{pair}: {value} [{ends[0]}, {ends[1]}] over {primary['pairs']} seeds, {shown}"


def _measure(name: str) -> str:
    """`auc_rare` for people."""
    kind, _, what = name.partition("_")
    where = "the rare conditions" if what == "rare" else words(what)
    return f"{where}, " + (
        "mean success during training" if kind == "auc" else "success at the end"
    )


def _gate(comparisons: Rows) -> Section:
    rows = [
        {
            "arm": one["arm"],
            "baseline": one["baseline"],
            "treatment": one["treatment"],
            "verdict": one["verdict"],
            **({"why": _why(one)} if any(map(_why, comparisons)) else {}),
        }
        for one in comparisons
    ]
    return Section(
        "gate",
        "Can they be compared?",
        intro="A comparison is refused if the critics were fed differently in something other "
        "than the treatment, or if there is too little data to decide.",
        tables=[Table(rows)],
    )


def _why(one: dict[str, Any]) -> str:
    return "" if one["verdict"] == "comparable" else why_refused(one)


def _contrasts(contrasts: Rows, rare: list[str]) -> Section | None:
    if not contrasts:
        return None
    rows = [
        {
            "contrast": f"{row['arm']} against {row['baseline']}"
            + (" (primary)" if row["primary"] else ""),
            "measure": _measure(row["measure"]),
            "difference [95 %]": interval_text(row["difference"], row["low"], row["high"], "+.3f")
            + no_interval_text(row.get("no_interval")),
            "arm": f"{row['arm_mean']:.3f}",
            "baseline": f"{row['baseline_mean']:.3f}",
            "seeds": str(row["pairs"]),
            "p": _p(row["p"]),
            "p adjusted": "" if row["primary"] else _p(row["p_holm"]),
        }
        for row in contrasts
    ]
    primary = any(row["primary"] for row in contrasts)
    return Section(
        "contrasts",
        "Contrasts",
        intro=f"Paired by seed, with Student's t over seeds. {which_adjusted(primary)} The rare"
        f" conditions are {', '.join(words(name) for name in rare)}.",
        tables=[Table(rows, set(rows[0]) - {"contrast", "measure"})],
    )


def _p(value: float | None) -> str:
    return "" if value is None else "< .001" if value < 0.001 else f"{value:.3f}"


def _arms(arms: Rows, order: list[str]) -> Section | None:
    """Show success by condition of every arm and reference, and its cost in safety."""
    if not arms:
        return None
    cells = [
        {"arm": row["arm"], "condition": name.removeprefix("success "), **_ends(value)}
        for row in arms
        for name, value in row.items()
        if name.startswith("success ")
    ]
    names = order + [row["arm"] for row in arms if row["arm"] not in order]
    rows = [
        {
            "arm": row["arm"],
            "runs": "" if row["runs"] is None else str(row["runs"]),
            **{
                title: "" if row.get(name) is None else _text(row[name], form)
                for name, (title, form) in SAFETY.items()
            },
        }
        for row in arms
    ]
    return Section(
        "arms",
        "Success and safety at the end",
        intro="The kept policies on the unperturbed episodes, means with 95 % intervals over "
        "seeds; safety in the rare missions. Time lost is against the planner, where both "
        f"arrived. From fewer than {MIN_PAIRS} seeds, and where all came to the same, there are "
        "values alone.",
        figures=[Figure(charts.intervals(cells, names), "Success by condition")] if cells else [],
        two=True,
        tables=[Table(rows, set(rows[0]) - {"arm"})],
    )


def _ends(value: list[float | None]) -> dict[str, float | None]:
    mean, low, high = value
    return {
        "value": mean,
        "low": low,
        "high": high,
    }


def _text(value: list[float | None], form: str) -> str:
    mean, low, high = value
    return "" if mean is None else interval_text(mean, low, high, form)


__all__ = ["study_page"]
