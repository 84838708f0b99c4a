"""`restock diff`: what is different between two stores, store versions, panels or runs?"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from restock.errors import ExitCode

if TYPE_CHECKING:
    from restock.replay.store.store import Store

SHOWN = 12  # rows of a table on a terminal; --json has all


@dataclass
class DiffCommand:
    """What is different between two stores, two versions of a store, two panels or two runs?

        restock diff monday/ tuesday/
        restock diff store@11 store                 # versions; store@2026-11-01 is as of that day
        restock diff panels/a panels/b
        restock diff runs/a runs/b

    Of stores: recordings and episodes that came and went, rows whose labels changed, the shares of
    conditions, zones and policies, and signals that shifted, with 95 % intervals over episodes. Of
    panels: mixture, rows, shares and weights. Of runs: settings, what their critics were fed, and
    their evaluations side by side. Two places of different tasks are refused: their rows do not
    mean the same. It only reads.
    """

    first: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="A")]
    """A store (or store@VERSION), a panel or a run: what was."""
    second: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="B")]
    """Another of the same kind: what is now."""
    exit_code: bool = False
    """Exit 1 where they differ."""
    json: bool = False
    """Print one JSON document, whole."""

    def run(self) -> int:
        """Compare, print, and say with the exit code whether they differ, where that was asked."""
        from restock.cli import output

        document = self._stores()
        if self.json:
            output.print_json(document)
        else:
            _print_stores(document)
        return int(ExitCode.FAILED if self.exit_code and document["different"] else ExitCode.OK)

    def _stores(self) -> dict[str, Any]:
        from restock.replay.fleet.store_difference import diff_stores

        with _open(self.first) as first, _open(self.second) as second:
            return diff_stores(first, second).document()


def _open(place: str) -> Store:
    from restock.ingest.store.version import split_version
    from restock.replay.store.store import Store

    path, version = split_version(place)
    return Store(path, version=version)


def _print_stores(document: dict[str, Any]) -> None:
    from restock.cli import output

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
        f"episodes: {episodes['in']:,} in, {episodes['out']:,} out, {episodes['changed']:,} with"
        f" other rows, {episodes['same']:,} the same"
    )
    _print_labels(document["labels"])
    _section(
        "shares (difference b - a in points, 95 % interval over episodes)",
        [_share(row) for row in document["shares"] if row["rows_a"] != row["rows_b"]],
    )
    signals = document["signals"]
    if signals["compared"]:
        shifted = [row for row in signals["shifts"] if (row["p_adjusted"] or 1) < 0.05]
        title = (
            f"signals that shifted: {signals['compared']} ({signals['episodes_b']:,} and"
            f" {signals['episodes_a']:,}), means of episodes"
        )
        if shifted:
            _section(title, [_signal(row) for row in shifted])
        else:
            output.stdout().print(f"\nno signal shifted: {signals['compared']}")


def _print_labels(labels: dict[str, Any]) -> None:
    from restock.cli import output

    if not labels["rows_compared"]:
        return
    _section("labels that changed", labels["changes"])
    line = f"of {labels['rows_compared']:,} rows written again {labels['rows_changed']:,} changed"
    line += " their condition"
    if labels["rows_with_other_changes"]:
        line += f", {labels['rows_with_other_changes']:,} more one that was not their main one"
    output.stdout().print(line)


def _section(title: str, rows: list[dict[str, Any]]) -> None:
    """A table, cut on a terminal, which says what it left out."""
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
        "interval": f"{_points(row['difference_low'])} to {_points(row['difference_high'])}",
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


def _short(value: Any) -> Any:
    """On a terminal a definition's SQL is cut; --json has it whole."""
    text = " ".join(str(value).split()) if value is not None else "(none)"
    return text if len(text) <= 100 or not sys.stdout.isatty() else f"{text[:99]}…"
