"""`restock coverage diff`: compare two stores, versions, panels or runs."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from restock.errors import ExitCode, RestockError


@dataclass
class DiffCommand:
    """Show the differences between two stores, two versions of a store, two panels or two runs.

        restock coverage diff monday/ tuesday/
        restock coverage diff store@11 store        # versions; store@2026-11-01 is as of that day
        restock coverage diff panels/a panels/b
        restock coverage diff runs/a runs/b

    Stores: recordings and episodes that were added or removed, rows whose labels changed, the
    shares of conditions, zones and policies, and signals that shifted, with 95 % intervals over
    episodes. Panels: mixture, rows, shares and weights. Runs: settings, what their critics were
    fed, and their evaluations side by side. Sources of different tasks are refused, as their rows
    have different meanings. The command only reads.
    """

    first: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="A")]
    """The first (earlier) store, store@VERSION, panel or run."""
    second: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="B")]
    """The second (later) one, of the same kind."""
    exit_code: bool = False
    """Exit 1 if they differ."""
    json: bool = False
    """Print one JSON document with everything."""

    def run(self) -> int:
        """Compare and print; with --exit-code, return whether they differ."""
        from restock.cli import output

        document = _difference(self.first, self.second)
        if self.json:
            output.print_json(document)
        else:
            show(document)
        return int(ExitCode.FAILED if self.exit_code and document["different"] else ExitCode.OK)


def _difference(first: str, second: str) -> dict[str, Any]:
    kinds = {place: _kind_of(place) for place in (first, second)}
    if len(set(kinds.values())) > 1:
        raise RestockError(
            f"{first} is a {kinds[first]}, {second} a {kinds[second]}",
            remedy="give two stores, two panels or two runs; the store of a run or panel is in "
            "its config.json or panel.json",
        )
    kind = kinds[first]
    if kind == "panel":
        from restock.replay.fleet.panel_difference import diff_panels
        from restock.replay.panel.panel import Panel

        return diff_panels(Panel.open(first), Panel.open(second))
    if kind == "run":
        from restock.train.judge.compare import diff_runs

        return diff_runs(Path(first), Path(second))
    from restock.cli import output
    from restock.replay.fleet.store_difference import diff_stores
    from restock.replay.store.store import Store

    with Store(first) as one, Store(second) as other:
        output.say_unverified(one)
        output.say_unverified(other)
        return diff_stores(one, other).document()


def _kind_of(place: str) -> str:
    """Tell a panel or a run by its own file; everything else is taken for a store."""
    from restock.replay.panel.panel import HEADER
    from restock.replay.places import RUN_CONFIG

    if "://" in place:
        return "store"
    if (Path(place) / HEADER).is_file():
        return "panel"
    return "run" if (Path(place) / RUN_CONFIG).is_file() else "store"


SHOWN = 12  # rows of a table on a terminal; --json has all


def show(document: dict[str, Any]) -> None:
    """Print a difference of any kind."""
    {"store": _print_stores, "panel": _print_panels, "run": _print_runs}[document["kind"]](document)


def _print_stores(document: dict[str, Any]) -> None:
    from restock.cli import output
    from restock.replay.fleet.store_difference import shifted

    a, b = document["a"], document["b"]
    names = [f"a: {a['path']} version {a['version']}", f"b: {b['path']} version {b['version']}"]
    output.print_table(
        [
            {"": what, names[0]: a[what], names[1]: b[what]}
            for what in ("recordings", "episodes", "rows", "hours")
        ]
    )
    if not document["different"]:
        output.stdout().print("no difference in recordings, episodes, labels or definitions")
        return
    _section(
        "definitions that differ",
        [{key: _short(value) for key, value in row.items()} for row in document["definitions"]],
    )
    _section("recordings", [_recording(row) for row in document["recordings"]])
    episodes = document["episodes"]
    output.stdout().print(
        f"episodes: {episodes['in']:,} added, {episodes['out']:,} removed, "
        f"{episodes['changed']:,} with changed rows, {episodes['same']:,} the same"
    )
    _print_labels(document["labels"])
    _section(
        "shares (difference b - a in points, 95 % interval over episodes)",
        [_share(row) for row in document["shares"] if row["rows_a"] != row["rows_b"]],
    )
    signals = document["signals"]
    if signals["compared"]:
        moved = shifted(signals["shifts"])
        title = (
            f"signals that shifted: {signals['compared']} ({signals['episodes_b']:,} and"
            f" {signals['episodes_a']:,}), means of episodes"
        )
        if moved:
            _section(title, [_signal(row) for row in moved])
        else:
            output.stdout().print(f"\nno signal shifted: {signals['compared']}")


def _print_panels(document: dict[str, Any]) -> None:
    from restock.cli import output

    _sides(document, ("id", "store", "store_version", "rows", "effective_rows", "logs_share"))
    if not document["different"]:
        output.stdout().print("the same panel: mixture, rows and weights")
        return
    _keys("header", document["header"])
    _keys("mixture", document["mixture"])
    rows, weights = document["rows"], document["weights"]
    output.stdout().print(
        f"rows: {rows['in']:,} in, {rows['out']:,} out, {rows['both']:,} in both;"
        f" {weights['rows_changed']:,} of those with another weight, largest"
        f" {weights['largest_a']:.3g} and {weights['largest_b']:.3g}"
    )
    _section("rows of both in another stratum", rows["moved"])
    _section(
        "strata: % of rows, wanted, drawn, after weights", [_stratum(s) for s in document["strata"]]
    )


def _print_runs(document: dict[str, Any]) -> None:
    from restock.cli import output

    _sides(document, ("env_steps", "gradient_steps", "panel"))
    settings = document["settings"]
    _section(
        "settings that differ",
        [
            {
                "setting": row["setting"],
                "kind": row["kind"],
                "a": _short(row["first"]),
                "b": _short(row["second"]),
            }
            for row in settings
        ],
    )
    if (panels := document["panels"]) is not None:
        if "note" in panels:
            output.stdout().print(f"panels: {panels['note']}", markup=False)
        else:
            output.stdout().print("\nTheir panels:")
            _print_panels(panels)
    _section("what the critics were fed, % of all rows drawn", [_fed(r) for r in document["fed"]])
    _section(
        "ages of the rows drawn, last interval",
        [
            {
                "source": row["source"],
                "unit": row["unit"],
                **{f"{n} {side}": row[f"{n}_{side}"] for n in ("p50", "p90") for side in "ab"},
            }
            for row in document["ages"]
        ],
    )
    if document["evaluation_note"]:
        output.stdout().print(f"evaluation: {document['evaluation_note']}", markup=False)
    _section(
        f"evaluation ({document['evaluated_by']}): paired differences b - a, 95 % over episodes",
        [_evaluation(row) for row in document["evaluation"]],
    )
    verdict = document["comparable"]
    output.stdout().print(
        f"\n`restock compare` says: {verdict['algorithm']} as methods, {verdict['mixture']} as"
        " mixtures (--treatment mixture)",
        markup=False,
    )


def _sides(document: dict[str, Any], names: tuple[str, ...]) -> None:
    from restock.cli import output

    heads = [f"{side}: {document[side]['path']}" for side in "ab"]
    output.print_table(
        [
            {"": name, heads[0]: document["a"][name], heads[1]: document["b"][name]}
            for name in names
        ],
        ["", *dict.fromkeys(heads)],
    )


def _keys(title: str, rows: list[dict[str, Any]]) -> None:
    _section(
        f"{title}: keys that differ",
        [{"key": row["key"], "a": _short(row["a"]), "b": _short(row["b"])} for row in rows],
    )


def _stratum(row: dict[str, Any]) -> dict[str, Any]:
    line = {"stratum": row["stratum"], "rows a": row["rows_a"], "rows b": row["rows_b"]}
    for name, shown in (
        ("natural_share", "natural"),
        ("wanted_share", "wanted"),
        ("share", "drawn"),
        ("effective_share", "weighted"),
    ):
        line |= {f"{shown} {side}": _percent(row[f"{name}_{side}"]) for side in "ab"}
    return line


def _fed(row: dict[str, Any]) -> dict[str, Any]:
    return {
        "source": row["source"],
        "condition": row["condition"],
        **{f"drawn {side}": _percent(row[f"share_{side}"]) for side in "ab"},
        **{f"weighted {side}": _percent(row[f"effective_share_{side}"]) for side in "ab"},
        **{f"episodes {side}": row[f"episodes_{side}"] for side in "ab"},
    }


def _evaluation(row: dict[str, Any]) -> dict[str, Any]:
    return {
        "perturbation": row["perturbation"],
        "condition": row["condition"],
        "episodes": row["episodes"],
        "success a": row["success_a"],
        "success b": row["success_b"],
        "difference": _with_interval(row, "difference"),
        "return a": row["return_a"],
        "return b": row["return_b"],
        "of return": _with_interval(row, "return_difference"),
    }


def _with_interval(row: dict[str, Any], name: str) -> str:
    value, low, high = (row[key] for key in (name, f"{name}_low", f"{name}_high"))
    if value is None:
        return "no goal"
    return f"{value:+.2f}" + (f" ({low:+.2f} to {high:+.2f})" if low is not None else "")


def _print_labels(labels: dict[str, Any]) -> None:
    from restock.cli import output

    if not labels["rows_compared"]:
        return
    _section("labels that changed", labels["changes"])
    line = f"{labels['rows_changed']:,} of {labels['rows_compared']:,} rows written again changed"
    line += " their condition"
    if labels["rows_with_other_changes"]:
        line += f", and {labels['rows_with_other_changes']:,} more changed another condition"
    output.stdout().print(line)


def _section(title: str, rows: list[dict[str, Any]]) -> None:
    """Print a table, cut on a terminal, with a note of what was left out."""
    from restock.cli import output

    if not rows:
        return
    shown = rows[:SHOWN] if sys.stdout.isatty() else rows
    output.stdout().print()
    output.print_table(shown, title=title)
    if len(shown) < len(rows):
        output.stdout().print(f"… {len(rows) - len(shown):,} more: --json has all")


def _recording(row: dict[str, Any]) -> dict[str, Any]:
    return {
        "change": row["change"],
        "recording": row["source_file"],
        "episodes a": row["episodes_a"],
        "episodes b": row["episodes_b"],
        "rows a": row["rows_a"],
        "rows b": row["rows_b"],
        "relabelled": row["rows_relabelled"],
    }


def _share(row: dict[str, Any]) -> dict[str, Any]:
    return {
        "of": row["of"],
        "value": row["value"],
        "rows a": row["rows_a"],
        "rows b": row["rows_b"],
        "% a": _percent(row["share_a"]),
        "% b": _percent(row["share_b"]),
        "difference": _points(row["difference"]),
        "interval": _ends(row["difference_low"], row["difference_high"]),
    }


def _signal(row: dict[str, Any]) -> dict[str, Any]:
    low, high = row["standardised_low"], row["standardised_high"]
    return {
        "signal": row["signal"],
        "mean a": row["mean_a"],
        "mean b": row["mean_b"],
        "in units of its spread": f"{row['standardised']:+.2f} ({low:+.2f} to {high:+.2f})",
        "KS distance": round(row["ks"], 3),
        "p (of all signals)": row["p_adjusted"],
    }


def _percent(share: float | None) -> float | None:
    return None if share is None else round(100 * share, 2)


def _points(difference: float) -> str:
    return f"{100 * difference:+.2f}" if difference == difference else "unknown"


def _ends(low: float, high: float) -> str:
    return f"{_points(low)} to {_points(high)}" if low == low else "unknown"


def _short(value: Any) -> Any:
    """Shorten a definition's SQL for a terminal; --json has it whole."""
    text = " ".join(str(value).split()) if value is not None else "(none)"
    return text if len(text) <= 100 or not sys.stdout.isatty() else f"{text[:99]}…"
