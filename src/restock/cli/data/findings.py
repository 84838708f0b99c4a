"""Findings of `restock audit --against` and `--baseline`, as if audits had made them.

So one JUnit writer and one table serve all.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from restock.errors import RestockError
from restock.replay.fleet.store_difference import shifted
from restock.replay.store.audit import (
    OFFENDED,
    SAMPLE_ROWS,
    WORST_FIRST,
    Audit,
    Finding,
    Severity,
    Status,
)

_MARKS = {"fail": "❌", "warn": "⚠️", "info": "ℹ️", "pass": "✅", "skipped": "–"}
SHOWN = 5  # rows of a finding in a summary


class Part(NamedTuple):
    """The findings of one part of a check: the audits, the difference or the regression."""

    name: str
    findings: list[Finding]


def of_difference(document: dict[str, Any], *, old: str) -> list[Finding]:
    """Return the difference of two stores (`StoreDifference.document`) as findings.

    What the new store lost is a failure. Changed definitions and labels are a warning, because they
    may be intended. New recordings are for information.
    """
    recordings, episodes = document["recordings"], document["episodes"]
    gone = [row for row in recordings if row["change"] == "out"]
    changes = episodes["changes"]
    with_recordings = {row["recording_id"] for row in gone}
    lost = [
        row
        for row in changes
        if row["change"] == "out" and row.get("recording_id") not in with_recordings
    ]
    labels = document["labels"]["changes"]
    return [
        _finding(
            "recordings_lost",
            "error",
            f"Recordings that are in {old} but not in this store",
            "ingest them again, or compare with a store without them",
            gone,
        ),
        _finding(
            "episodes_lost",
            "error",
            f"Episodes that are in {old} but not in this store, of recordings that are in both",
            "find out what changed: the profile, the conditions, or a damaged recording",
            lost,
        ),
        _finding(
            "definitions_changed",
            "warning",
            "Conditions, labels or profiles with changed definitions",
            "if this was not intended, restore the old ones and ingest again",
            [row for row in document["definitions"] if row["what"] != "restock_version"],
        ),
        _finding(
            "labels_changed",
            "warning",
            "Rows whose condition changed",
            "`restock coverage diff` shows all of them; `restock store label STORE --review` lets "
            "a person check labels",
            labels,
        ),
        _finding(
            "signals_shifted",
            "warning",
            "Signals whose mean over episodes shifted (false discovery rate 5 %)",
            "`restock coverage drift` shows which robot, week and part",
            shifted(document["signals"]["shifts"]),
        ),
        _finding(
            "recordings_new",
            "info",
            "Recordings that were added, or written again",
            "nothing to do: these recordings explain the differences",
            [row for row in recordings if row["change"] != "out"],
        ),
    ]


def of_regression(rows: Sequence[dict[str, Any]], *, baseline: str) -> list[Finding]:
    """Return a finding for each row of a run's regression against a baseline."""
    found = []
    for row in rows:
        severity: Severity = "error" if row["verdict"] in ("worse", "refused") else "warning"
        bad = row["verdict"] in ("worse", "refused", "inconclusive")
        reported = f"Success in {row['condition']}, {row['perturbation']}, against {baseline}"
        shown = {key: value for key, value in row.items() if value is not None}
        found.append(
            _finding(
                f"{row['perturbation']}.{row['condition']}",
                severity,
                reported,
                row["reason"] or "`restock compare` and `restock diagnose` help to find out why",
                [shown] if bad else [],
            )
        )
    return found


def refused(name: str, error: RestockError, *, option: str) -> list[Finding]:
    """Return a failure for what could not be compared, which a pipeline must not pass over.

    `option` is the option that asked for it, with its value.
    """
    row = {"what": error.what, "where": error.where or ""}
    where = f"{error.where}: " if error.where and error.where not in option else ""
    advice = error.remedy or f"correct {option.split()[0]}, or leave it out"
    return [_finding(name, "error", f"{option}: {where}{error.what}", advice, [row])]


def _finding(
    name: str, severity: Severity, doc: str, advice: str, rows: Iterable[dict[str, Any]]
) -> Finding:
    every = list(rows)
    status: Status = OFFENDED[severity] if every else "pass"
    audit = Audit(name, severity, advice, doc, None, "")
    columns = list(every[0]) if every else []
    return Finding(audit, status, len(every), columns, every[:SAMPLE_ROWS], {})


def markdown(title: str, parts: Sequence[Part], *, failing: set[str]) -> str:
    """Write a summary as Markdown for a pipeline's page, failures first."""
    every = [(part.name, one) for part in parts for one in part.findings]
    every.sort(key=lambda pair: WORST_FIRST.index(pair[1].status))
    failed = sum(one.status in failing for _, one in every)
    passed = sum(one.status == "pass" for _, one in every)
    verdict = f"**{failed} failed**" if failed else "**passed**"
    lines = [
        f"## {_MARKS['fail' if failed else 'pass']} {title}",
        "",
        f"{verdict}; of {len(every)} checks {passed} passed,"
        f" {sum(one.status == 'skipped' for _, one in every)} were skipped.",
        "",
    ]
    shown = [(name, one) for name, one in every if one.status not in ("pass", "skipped")]
    if shown:
        lines += ["| | check | rows | what |", "| --- | --- | ---: | --- |"]
        lines += [
            f"| {_MARKS[one.status]} {one.status} | {name}: `{one.audit.name}` | {one.rows:,} |"
            f" {_cell(one.audit.doc)} |"
            for name, one in shown
        ]
    for name, one in shown:
        if one.status not in failing:
            continue
        lines += ["", f"### {name}: {one.audit.name}", "", f"{one.audit.advice}", ""]
        columns = one.columns
        lines += [f"| {' | '.join(map(_cell, columns))} |", f"|{' --- |' * len(columns)}"]
        lines += [
            f"| {' | '.join(_cell(row[column]) for column in columns)} |"
            for row in one.sample[:SHOWN]
        ]
        if one.rows > SHOWN:
            lines.append(f"\n… {one.rows - SHOWN:,} more")
    return "\n".join(lines) + "\n"


def _cell(value: Any) -> str:
    """Return a value for a Markdown table: one line, without markup."""
    text = "" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)
    text = " ".join(text.split())
    text = text if len(text) <= 100 else f"{text[:99]}…"
    return re.sub(r"([\\`|*_\[\]])", r"\\\1", text).replace("<", "&lt;").replace(">", "&gt;")
