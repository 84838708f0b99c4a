"""`restock coverage diff`: compare two stores, versions or panels."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

from restock.cli import output
from restock.cli.words import Positional
from restock.errors import ExitCode, RestockError, quoted


@dataclass
class DiffCommand:
    """Show the differences between two stores, two versions of a store, or two panels.

        restock coverage diff monday/ tuesday/
        restock coverage diff store@11 store        # versions; store@2026-11-01 is as of that day
        restock coverage diff panels/a panels/b

    Stores: recordings and episodes that were added or removed, rows whose labels changed, and the
    shares of conditions, zones and policies. Panels: mixture, rows, shares and weights. Sources of
    different tasks are refused, as their rows have different meanings. The command only reads.
    `restock compare` compares runs.
    """

    first: Annotated[str, Positional("A")]
    """The first (earlier) store, store@VERSION or panel."""
    second: Annotated[str, Positional("B")]
    """The second (later) one, of the same kind."""
    exit_code: bool = False
    """Exit 1 if they differ."""
    json: bool = False
    """Print one JSON document with everything."""

    def run(self) -> int:
        """Compare and print; with --exit-code, return whether they differ."""
        document = _difference(self.first, self.second)
        if self.json:
            output.print_json(document)
        else:
            show(document)
        return int(ExitCode.FAILED if self.exit_code and document["different"] else ExitCode.OK)


def _difference(first: str, second: str) -> dict[str, Any]:
    from restock.replay.places import kind_beside

    kinds = {place: kind_beside(place) or "store" for place in (first, second)}
    if len(set(kinds.values())) > 1:
        raise RestockError(
            f"{first} is a {kinds[first]}, {second} a {kinds[second]}",
            remedy="give two stores or two panels; a panel's store is in its panel.json",
        )
    kind = kinds[first]
    if kind == "panel":
        from restock.replay.fleet.panel_difference import diff_panels
        from restock.replay.panel.panel import Panel

        return diff_panels(Panel.open(first), Panel.open(second))
    if kind == "run":
        remedy = f"`restock compare {quoted(first)} {quoted(second)}` compares runs"
        raise RestockError("is a run", where=first, remedy=remedy)
    from restock.replay.fleet.store_difference import diff_stores
    from restock.replay.store.store import Store

    with Store(first) as one, Store(second) as other:
        output.say_unverified(one)
        output.say_unverified(other)
        return diff_stores(one, other)


# Columns of a document's rows -> their titles.
_DEFINITIONS = {"what": "what", "a": "a", "b": "b"}
_KEYS = {"key": "key", "a": "a", "b": "b"}
_RECORDINGS = {
    **{"change": "change", "source_file": "recording", "episodes": "episodes", "rows": "rows"},
    "rows_relabelled": "relabelled",
}
_SHARES = {"of": "of", "value": "value", "rows": "rows", "share": "%", "difference": "difference"}
_STRATA = {
    **{"stratum": "stratum", "rows": "rows", "natural_share": "natural", "wanted_share": "wanted"},
    **{"share": "drawn", "effective_share": "weighted"},
}


def show(document: dict[str, Any]) -> None:
    """Print a difference of any kind."""
    {"store": _print_stores, "panel": _print_panels}[document["kind"]](document)


def _print_stores(document: dict[str, Any]) -> None:
    a, b = document["a"], document["b"]
    heads = (f"a: {a['path']} version {a['version']}", f"b: {b['path']} version {b['version']}")
    _print_sides(document, heads, ("recordings", "episodes", "rows", "hours"))
    if not document["different"]:
        output.print_text("no difference in recordings, episodes, labels or definitions")
        return
    section("definitions that differ", _select_columns(document["definitions"], _DEFINITIONS))
    section("recordings", _select_columns(document["recordings"], _RECORDINGS))
    episodes = document["episodes"]
    output.print_text(
        f"episodes: {episodes['in']:,} added, {episodes['out']:,} removed, "
        f"{episodes['changed']:,} with changed rows, {episodes['same']:,} the same"
    )
    _print_labels(document["labels"])
    shares = [
        row | {"difference": _value("share", row["difference"])}
        for row in document["shares"]
        if row["rows_a"] != row["rows_b"]
    ]
    section("shares (difference b - a in points)", _select_columns(shares, _SHARES))


def _print_panels(document: dict[str, Any]) -> None:
    names = ("id", "store", "store_version", "rows", "effective_rows", "logs_share")
    _print_sides(document, [f"{side}: {document[side]['path']}" for side in "ab"], names)
    if not document["different"]:
        output.print_text("the same panel: mixture, rows and weights")
        return
    for part in ("header", "mixture"):
        section(f"{part}: keys that differ", _select_columns(document[part], _KEYS))
    rows, weights = document["rows"], document["weights"]
    output.print_text(
        f"rows: {rows['in']:,} in, {rows['out']:,} out, {rows['both']:,} in both;"
        f" {weights['rows_changed']:,} of those with another weight, largest"
        f" {weights['largest_a']:.3g} and {weights['largest_b']:.3g}"
    )
    section("rows of both in another stratum", rows["moved"])
    strata = _select_columns(document["strata"], _STRATA)
    section("strata: % of rows, wanted, drawn, after weights", strata)


def _print_sides(document: dict[str, Any], heads: Sequence[str], names: Sequence[str]) -> None:
    a, b = document["a"], document["b"]
    output.print_table([{"": name, heads[0]: a[name], heads[1]: b[name]} for name in names])


def _select_columns(rows: list[dict[str, Any]], columns: dict[str, str]) -> list[dict[str, Any]]:
    """Select and rename columns; a column with values for both sides becomes two, a and b."""
    return [
        {title: value for name, of in columns.items() for title, value in _cells(row, name, of)}
        for row in rows
    ]


def _cells(row: dict[str, Any], name: str, title: str) -> Iterator[tuple[str, Any]]:
    if f"{name}_a" in row:
        for side in "ab":
            yield f"{title} {side}", _value(name, row[f"{name}_{side}"])
    else:
        yield title, _value(name, row[name])


def _value(name: str, value: Any) -> Any:
    """Convert shares to percent, and cut long texts on a terminal; --json has the full values."""
    if name.endswith("share"):
        return None if value is None else round(100 * value, 2)
    if isinstance(value, int | float):
        return value
    text = " ".join(str(value).split()) if value is not None else "(none)"
    return text if len(text) <= 100 or not sys.stdout.isatty() else f"{text[:99]}…"


def _print_labels(labels: dict[str, Any]) -> None:
    if not labels["rows_compared"]:
        return
    section("labels that changed", labels["changes"])
    line = f"{labels['rows_changed']:,} of {labels['rows_compared']:,} rows written again changed"
    line += " their condition"
    if labels["rows_with_other_changes"]:
        line += f", and {labels['rows_with_other_changes']:,} more changed another condition"
    output.print_text(line)


def section(title: str, rows: list[dict[str, Any]]) -> None:
    """Print a table after an empty line; nothing if it has no rows."""
    if rows:
        output.print_text()
        output.print_table(rows, title=title)
