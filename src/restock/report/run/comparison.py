"""The pages of a study and of a gate, and the sections of a comparison of two methods."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from restock.report.look import charts
from restock.report.look.blocks import (
    Figure,
    Rows,
    Section,
    Table,
    better_and_worse,
    count,
    points_text,
    span,
    words,
)
from restock.stats import MIN_PAIRS, interval_text, no_interval_text, which_adjusted
from restock.train.judge.sequential import NOT_SHOWN, NOT_WORSE, WORSE

MAX_SETTINGS = 4  # if more settings differ, the sentence names none of them
FREE_KINDS = ("free", "software")
_ALLOWED = {"incomparable": "differs: allowed", "inconclusive": "may differ: allowed"}
HELD = {"feed": "replay", "target": "the target rule", "algorithm": "the algorithm"}
_INTERVALS = (
    "Intervals are 95 %, over seeds and episodes; with fewer than three seeds or ten episodes, "
    "only values are shown."
)


def headline(found: dict[str, Any], first: str, second: str) -> str:
    """State in which conditions the second differs from the first, with intervals."""
    if found["verdict"] != "comparable":
        return f"{second} and {first} cannot be compared: {found['why']}"
    rows = [row for row in found["outcomes"] if row["perturbation"] == "none"] or found["outcomes"]
    known = [row for row in rows if row["difference_low"] is not None]
    parts, shown = better_and_worse(known)
    if parts:
        rest = len(rows) - shown
        more = f"; no difference shown in {rest} more" if rest else ""
        return f"{second} is {', '.join(parts)} than {first}{more}"
    if not known:
        why = next((row["no_interval"] for row in rows if row["no_interval"]), "too little data")
        return f"{second} against {first}: no difference can be measured ({why})"
    widest = max(known, key=lambda row: row["difference_high"] - row["difference_low"])
    return (
        f"No difference between {second} and {first} is shown in any condition; the widest"
        f" interval is {points_text(widest)} in {words(widest['condition'])}"
    )


def outcome_section(found: dict[str, Any], first: str, second: str, prefix: str = "") -> Section:
    """Return a section with the outcomes, or with the reason why there are none."""
    name, title, treatment = f"{prefix}outcomes", f"{second} against {first}", _treatment(found)
    rows = found["outcomes"]
    if found["verdict"] != "comparable" or not rows:
        refused = f"Gate refused: {found['verdict']}: {found['why']}."
        why = "No condition was driven by both." if found["verdict"] == "comparable" else refused
        return Section(name, title, intro=treatment, callout=why)
    reasons = list(dict.fromkeys(row["no_interval"] for row in rows if row["no_interval"]))
    table = [
        {
            "perturbation": "clean" if row["perturbation"] == "none" else row["perturbation"],
            "condition": words(row["condition"]),
            first: _share(row["success"][0]),
            second: _share(row["success"][1]),
            "difference [95 %]": ""
            if row["difference"] is None
            else interval_text(
                row["difference"], row["difference_low"], row["difference_high"], "+.2f"
            ),
            "P(higher return) [95 %]": interval_text(
                row["improvement"], row.get("improvement_low"), row.get("improvement_high")
            ),
            "episodes": count(row["episodes"]),
            "runs": f"{row['runs'][0]} and {row['runs'][1]}",
        }
        for row in rows
    ]
    figures = []
    if any(row["difference"] is not None for row in rows):
        caption = f"Right of the line {second} is better."
        figures = [Figure(charts.differences(rows), "Difference in success", caption)]
    return Section(
        name,
        title,
        intro=f"{treatment} Both drove the same episodes, from {found['outcomes_from']}."
        f" {_INTERVALS}" + (f" No interval: {'; '.join(reasons)}." if reasons else ""),
        figures=figures,
        tables=[
            Table(
                table,
                caption="P(higher return): the probability that the return of"
                f" {second} on an episode is higher, ties counting half, over all pairs of"
                " runs; 0.5 means no difference.",
            )
        ],
    )


def _treatment(found: dict[str, Any]) -> str:
    """Describe the treatment and, for a comparison of methods, what was held fixed."""
    names: dict[str, list[str]] = {}  # kind of setting -> differing settings
    for row in found["differences"]:
        name = row["setting"].removeprefix("config.")
        kind = names.setdefault(row["kind"], [])
        if name not in kind:
            kind.append(name)
    if found["treatment"] != "method":
        named = [one for kind, of in names.items() if kind not in FREE_KINDS for one in of]
        few = f"; what differs: {', '.join(named)}" if 0 < len(named) <= MAX_SETTINGS else ""
        return f"Treatment: {found['treatment']}{few}."
    varied = [
        f"{words} ({', '.join(names[kind])})" for kind, words in HELD.items() if kind in names
    ]
    fixed = ["environment steps", *(HELD[kind] for kind in ("feed", "target") if kind not in names)]
    return (
        "Treatment: method. Held fixed: the environment and its conditions,"
        f" {', '.join(fixed)} and the evaluation. Not held: {'; '.join(varied) or 'nothing'}."
    )


def _share(value: float | None) -> str:
    return "no goal" if value is None else f"{value:.2f}"


def curves_section(rows: Rows, arms: list[str]) -> Section | None:
    """Show success over training; None if no run was evaluated during training."""
    if not rows:
        return None
    most = max(row["runs"] for row in rows)
    bands = (
        f"Bands are 95 % over up to {most} seeds (Student's t)."
        if any(row["low"] is not None for row in rows)
        else f"There is no band with fewer than {MIN_PAIRS} seeds, or if all seeds gave the same"
        " value; another seed would give another curve."
    )
    return Section(
        "curves",
        "How did they learn?",
        intro=f"Greedy success at the evaluations in training, mean over seeds. {bands}",
        figures=[Figure(charts.curves(rows, arms))],
    )


def gate_section(found: dict[str, Any], first: str, second: str) -> Section:
    """Show the settings that differ, and the checks of what the critics were fed."""
    refused = set(found["refused"])
    differences = [
        {
            "setting": row["setting"],
            first: _setting(row["first"]),
            second: _setting(row["second"]),
            "kind": row["kind"],
            "allowed": "no" if row["setting"] in refused else "yes",
        }
        for row in found["differences"]
    ]
    order = {"incomparable": 0, "inconclusive": 1, "comparable": 2}
    checks = [
        {
            "check": words(row["name"]),
            "part": words(row["part"]),
            first: _setting(row["first"]),
            second: _setting(row["second"]),
            "value": _setting(row["value"]),
            "95 %": _ends(row["low"], row["high"]),
            "limit": f"{row['limit']:g}",
            "verdict": row["verdict"]
            if row["decides"]
            else _ALLOWED.get(row["verdict"], row["verdict"]),
        }
        for row in sorted(
            found["checks"], key=lambda row: (not row["decides"], order[row["verdict"]])
        )
    ]
    return Section(
        "gate",
        "The checks of the gate",
        intro=f"Compared: the {found['treatment']}. Everything else must be the same: settings, "
        "and what the critics were fed, by equivalence tests. Failed checks come first; what the "
        "treatment allows to differ is shown last, and decides nothing.",
        tables=[
            Table(differences, title=f"What differs (treatment: {found['treatment']})"),
            Table(checks, title="What was fed", folded=True),
        ],
    )


def _setting(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float) else "" if value is None else str(value)


def _ends(low: float | None, high: float | None) -> str:
    """Format an interval; an end is None if a share was zero in some resample."""
    if low is None:
        return "" if high is None else f"up to {high:.3g}"
    return f"{low:.3g} or more" if high is None else f"{low:.3g} to {high:.3g}"


def _costs(rows: Rows) -> dict[str, str]:
    """Describe the cost of training one run, for each arm."""
    return {
        row["arm"]: ", ".join(
            ([] if row["wall_s"] is None else [span(row["wall_s"])])
            + ([f"{row['env_steps']:,.0f} steps"] if row["env_steps"] else [])
            + ([f"{row['gradient_steps']:,.0f} updates"] if row["gradient_steps"] else [])
        )
        for row in rows
    }


SAFETY = {
    "bumps_per_km": ("bumps per km", ".1f"),
    "closest_person_m": ("closest person, m", ".2f"),
    "time_lost_s": ("time lost, s", "+.1f"),
    "discounted_return": ("discounted return", ".2f"),
}


def study_page(study: dict[str, Any], name: str = "") -> dict[str, Any]:
    """Return the content of the page of a study (`study.json`), for `write_page`."""
    comparisons = study["comparisons"]
    refused = [one for one in comparisons if one["verdict"] != "comparable"]
    arms = list(study["runs"])
    sections = [
        _study_gate(comparisons),
        _contrasts(study["contrasts"], study["rare"]),
        _arms(study["arms"], arms, _costs(study["cost"])),
        curves_section(study["curves"], arms),
        *(
            outcome_section(one, one["baseline"], one["arm"], f"c{number}-")
            for number, one in enumerate(comparisons)
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
        "headline": _study_headline(study),
        "lead": (f"{study['doc']} " if study["doc"] else "")
        + f"{len(arms)} arms, seeds {', '.join(map(str, study['seeds']))}, all evaluated on the"
        " same episodes.",
        "sections": sections,
    }


def _study_headline(study: dict[str, Any]) -> str:
    """State the result of the study's primary contrast, or else of its first comparison."""
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
    """Name a measure such as `auc_rare` in words."""
    kind, _, what = name.partition("_")
    where = "the rare conditions" if what == "rare" else words(what)
    return f"{where}, " + (
        "mean success during training" if kind == "auc" else "success at the end"
    )


def _study_gate(comparisons: Rows) -> Section:
    rows = [
        {
            "arm": one["arm"],
            "baseline": one["baseline"],
            "treatment": one["treatment"],
            "verdict": one["verdict"],
            "why": one["why"],
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
        tables=[Table(rows)],
    )


def _p(value: float | None) -> str:
    return "" if value is None else "< .001" if value < 0.001 else f"{value:.3f}"


def _arms(arms: Rows, order: list[str], costs: dict[str, str]) -> Section | None:
    """Show success by condition of every arm and reference, safety, and the cost of training."""
    if not arms:
        return None
    cells = [
        {"arm": row["arm"], "condition": name.removeprefix("success ")}
        | dict(zip(("value", "low", "high"), value, strict=True))
        for row in arms
        for name, value in row.items()
        if name.startswith("success ")
    ]
    names = order + [row["arm"] for row in arms if row["arm"] not in order]
    rows = [
        {
            "arm": row["arm"],
            "runs": "" if row["runs"] is None else str(row["runs"]),
            **{title: _text(row.get(name), form) for name, (title, form) in SAFETY.items()},
            "training of a run": costs.get(row["arm"], ""),
        }
        for row in arms
    ]
    return Section(
        "arms",
        "Success and safety at the end",
        intro="The kept policies on the unperturbed episodes, means with 95 % intervals over "
        "seeds; safety in the rare missions. Time lost is against the planner, over the missions "
        f"that both completed. With fewer than {MIN_PAIRS} seeds, or if all gave the same value, "
        "there is no interval.",
        figures=[Figure(charts.intervals(cells, names), "Success by condition")] if cells else [],
        tables=[Table(rows)],
    )


def _text(value: tuple[float | None, ...] | None, form: str) -> str:
    """Format [mean, low, high]; nothing without a mean."""
    mean, low, high = value or (None, None, None)
    return "" if mean is None else interval_text(mean, low, high, form)


_GATE_KINDS = {NOT_WORSE: "good", NOT_SHOWN: "open", WORSE: "bad"}
_WORDS = {NOT_WORSE: "shown not worse", NOT_SHOWN: "not shown", WORSE: "shown worse"}
_COLOURS = dict(zip(_WORDS.values(), ("#0f766e", "#b58900", "#be185d"), strict=True))


def gate_page(document: dict[str, Any]) -> dict[str, Any]:
    """Return the content of the page of a gate, for `write_page`."""
    cells, policy = document["cells"], document["policy"]
    return {
        "kicker": "gate",
        "title": f"May {Path(document['run']).name} drive instead of {document['baseline']}?",
        "verdict": {"kind": _GATE_KINDS[document["verdict"]], "text": _WORDS[document["verdict"]]},
        "headline": document["claim"][0].upper() + document["claim"][1:],
        "lead": ("" if policy is None else f"{policy['text'].capitalize()}. ")
        + "Both drove the same missions in the twin, until each condition was decided or its budget"
        f" of {count(document['budget'])} pairs was spent.",
        "sections": [
            _evidence(cells),
            Section(
                "limits",
                "What this does not say",
                tables=[Table([{"limit": line} for line in document["limits"]])],
            ),
        ],
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
    drawn = [
        cell
        | {"cell": cell["name"] + (f", {cell['layouts']}" if len(floors) > 1 else "")}
        | {"verdict": _WORDS[cell["verdict"]], "limit": -cell["margin"]}
        for cell in cells
        if cell["difference"] is not None
    ]
    figures = [
        Figure(
            charts.estimates(
                [cell for cell in drawn if cell["measure"] == measure],
                y="cell",
                series="verdict",
                names=[name for name in _COLOURS if name in {cell["verdict"] for cell in drawn}],
                colours=_COLOURS,
                value="difference",
                ends=("low", "high"),
                neutral=0.0,
                tick="limit",
            ),
            f"{words(measure).capitalize()}: by how much the policy was better",
            "The bounds hold after every pair. The policy is shown not to be worse once the lower"
            " bound is above the tick, which marks the margin.",
        )
        for measure in dict.fromkeys(cell["measure"] for cell in drawn)
    ]
    return Section("evidence", "Evidence", figures=figures, two=True, tables=[Table(rows)])
