"""`restock store label STORE --score`: how good the labels are, by step and by event."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from restock.errors import ExitCode

if TYPE_CHECKING:
    from restock.replay.store.label_quality import LabelQuality
    from restock.stats import ConfidenceInterval


def print_scores(path: Path, by: str | None, *, json: bool) -> int:
    """Print precision and recall of each condition, and how reliable the probabilities are."""
    from restock.cli import output
    from restock.replay.store.label_quality import label_quality, reliability
    from restock.replay.store.store import Store

    with Store(path) as store:
        found = label_quality(store, by)
        bins = reliability(store).to_pylist()
    if json:
        rows = [quality_json(one) for one in found]
        output.print_json({"scores": rows, "reliability": bins})
        return ExitCode.OK
    if not found:
        output.stdout().print(
            "no recording in the store contains the true conditions: nothing to score"
        )
        return ExitCode.OK
    output.print_table(score_rows(found, by))
    reported = [row for row in bins if row["known"]]
    if reported:
        output.stdout().print(
            "\nA probability is reliable if, among steps with probability p, a share p is true:"
        )
        output.print_table(reliability_rows(reported))
    return ExitCode.OK


def score_rows(found: Sequence[LabelQuality], by: str | None) -> list[dict[str, Any]]:
    """Return a table row for each condition and group."""
    return [
        ({by: one.group} if by else {})
        | {
            "condition": one.score.condition,
            "true steps": one.score.support,
            "precision": _interval(one.precision),
            "recall": _interval(one.recall),
            "true events": one.score.event_support,
            "event precision": _interval(one.event_precision),
            "event recall": _interval(one.event_recall),
            "uncertain": one.uncertain,
        }
        for one in found
    ]


def reliability_rows(bins: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return a row for each condition: the true share of steps by tenths of probability."""
    rows: dict[str, dict[str, Any]] = {}
    for one in bins:
        row = rows.setdefault(one["condition"], {"condition": one["condition"]})
        row |= {f"{tenth / 10:g}+": row.get(f"{tenth / 10:g}+", "") for tenth in range(10)}
        row[f"{one['from_probability']:g}+"] = f"{one['true_share']:.2f} of {one['known']:,}"
    return list(rows.values())


def quality_json(one: LabelQuality) -> dict[str, Any]:
    """Return counts, and shares with 95 % intervals, as `--json` prints them."""
    from dataclasses import asdict

    shares = ("precision", "recall", "event_precision", "event_recall")
    return {
        "group": one.group,
        **asdict(one.score),
        "uncertain": one.uncertain,
        **{name: asdict(getattr(one, name)) for name in shares},
    }


def _interval(share: ConfidenceInterval) -> str:
    if share.value != share.value:
        return "-"
    return f"{share.value:.2f} ({share.low:.2f} to {share.high:.2f})"
