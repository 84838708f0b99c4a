"""Summaries of stages in a few lines, from the documents that their verbs print."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

from restock.errors import counted
from restock.stats import interval_text

Document = Mapping[str, Any]  # what a verb prints with --json; empty if it has not run
ESTIMATORS = {
    "logged": "as the logs were driven",
    "fqe": "the policy, by a fitted model (fqe)",
    "pdwis": "by importance weights (pdwis)",
}


def info(document: Document) -> list[str]:
    """Say how much was recorded."""
    recordings = document["recordings"]
    seconds = sum(row["duration_s"] or 0.0 for row in recordings)
    messages = sum(row["messages"] for row in recordings)
    lines = [
        f"{counted(len(recordings), 'recording')}, {_format_time(seconds)}, {messages:,} messages"
    ]
    return lines + _first_lines(
        [f"damaged: {row['path']}: {what}" for row in recordings for what in row["damage"]]
    )


def propose(document: Document) -> list[str]:
    """Say how many transitions the proposed profile gives, and what it could not use."""
    made, ticks = counted(document["transitions"], "transition"), counted(document["ticks"], "tick")
    lines = [f"{made} of {ticks}"]
    if unread := document.get("unread"):
        read = len(document["read"])
        lines[0] += f", by the {read} largest of {read + len(unread):,} recordings of this robot"
    lines += _first_lines(
        [f"left out, as it cannot be read: {one}" for one in document.get("unreadable", [])]
    )
    lines += _first_lines([f"lost: {loss}" for loss in document.get("losses", [])])
    lines += [f"to consider: `{each['key']}`: {each['text']}" for each in document["advice"]]
    return lines


def check(document: Document) -> list[str]:
    """Say how many transitions the profile gives, and what stands in for missing inputs."""
    if (outcome := document["outcome"]) is None:
        return list(document["problems"])
    made = counted(outcome["transitions"], "transition")
    episodes = counted(outcome["episodes"], "episode")
    lines = [
        *document["problems"],
        f"{made} in {episodes} of {_format_time(outcome['duration_s'])}",
    ]
    missing = [
        f"{item['input']} ({item['instead']})"
        for item in outcome["stand_ins"]
        if item["input"].split()[0] in _NAMED_INPUTS
    ]
    return lines + ([f"not in the recording: {'; '.join(missing)}"] if missing else [])


_NAMED_INPUTS = ("scan", "imu", "bumper", "goal", "plan", "wheels")  # inputs to name if missing


def ingest(document: Document) -> list[str]:
    """Describe the rows, and what failed."""
    rows = document["recordings"]
    held = [row for row in rows if row["status"] != "failed"]
    good = list({row["recording_id"]: row for row in reversed(held)}.values())[::-1]
    transitions = sum(row["transitions"] for row in good)
    episodes = sum(row["episodes"] for row in good)
    lines = [
        f"{counted(transitions, 'transition')} in {counted(episodes, 'episode')} of"
        f" {counted(len(good), 'recording')}"
    ]
    if copies := len(held) - len(good):
        lines.append(f"{counted(copies, 'recording')} given again, as a copy: not counted")
    unknown = {
        one["condition"]: one["because"] for row in good for one in row["unknown_conditions"] or []
    }
    if unknown:
        why = ", ".join(dict.fromkeys(unknown.values()))
        lines.append(f"unknown for some or all rows ({why}): {', '.join(unknown)}")
    dropped: Counter[str] = Counter()
    for drop in (drop for row in good for drop in row["drops"]):
        dropped[drop["reason"]] += drop["count"]
    if dropped:
        worst = ", ".join(f"{why} {n:,}" for why, n in dropped.most_common(3))
        lines.append(f"ticks left out: {worst}")
    failed = [row["error"].splitlines()[0] for row in rows if row["status"] == "failed"]
    lost = [f"lost: {row['path']}: {what}" for row in good for what in row["losses"]]
    return lines + _first_lines([f"not ingested: {why}" for why in failed]) + _first_lines(lost)


def _first_lines(lines: list[str], most: int = 3) -> list[str]:
    """Return the first `most` lines, and a line with the number of further ones."""
    more = [f"… and {len(lines) - most} more"] if len(lines) > most else []
    return lines[:most] + more


def coverage(document: Document) -> list[str]:
    """Count the rows of each condition; the count is unknown if a signal or a plan is missing."""
    counts = {row["condition"]: row["rows_held"] for row in document["rows"]}
    shown = [f"{name} {'unknown' if n is None else f'{n:,}'}" for name, n in counts.items()]
    return [f"rows that hold each condition: {', '.join(shown)}"]


def audit(document: Document) -> list[str]:
    """Name the audits that failed or warned."""
    lines = []
    for status, word in (("fail", "failed"), ("warn", "warned")):
        names = [item["audit"] for item in document["audits"] if item["status"] == status]
        lines += [f"{len(names)} {word}: {', '.join(names)}"] if names else []
    return [*lines, "`restock audit STORE` explains each one"] if lines else ["all passed"]


def mix(document: Document) -> list[str]:
    """Count the panel's rows, and name the strata that are short of rows."""
    short = [line["stratum"] for line in document["strata"] if line["missing_rows"]]
    lines = [f"panel {document['id']}: {counted(document['rows'], 'row')} to learn from"]
    if held := document["evaluation_split"]["rows"]:
        lines[0] += f", {held:,} held out for evaluation"
    if note := document["evaluation_split"]["note"]:
        lines.append(f"held out: {note}")
    if short:
        lines.append(
            f"fewer rows than wanted of {', '.join(short)}: more logs or the twin would help"
        )
    return lines


def floor(document: Document) -> list[str]:
    """Say what the floor was made from, how large it is, and which missions fit."""
    aisles = counted(document["aisle_segments"], "aisle segment")
    lines = [
        f"made from {document['made_from']}: {document['width_m']:g} x {document['depth_m']:g} m,"
        f" {counted(document['goals'], 'goal')}, {aisles}; room for"
        f" {', '.join(document['episodes']) or 'no episode'}"
    ]
    return [*lines, *document["notes"]]


def fit(document: Document) -> list[str]:
    """Say which parameters the logs determine, and which they do not."""
    estimates = document["fits"][0]["estimates"]
    fitted = [
        f"{item['name']} {interval_text(item['value'], item['low'], item['high'], '.3g')}"
        for item in estimates
        if item["fitted"]
    ]
    unknown = [item["name"] for item in estimates if not item["fitted"]]
    return [f"fitted: {', '.join(fitted) or 'nothing'}"] + (
        [f"not identified by these logs: {', '.join(unknown)}"] if unknown else []
    )


def gap(document: Document) -> list[str]:
    """Say in which conditions the twin may be trusted."""
    by: dict[str, list[str]] = {}
    for item in document["verdicts"]:
        by.setdefault(item["verdict"], []).append(item["condition"])
    lines = ["; ".join(f"{verdict}: {', '.join(names)}" for verdict, names in by.items())]
    nominal = nominal_verdict(document)
    return lines + [f"nominal: {reason}" for reason in (nominal or {}).get("reasons", [])]


def nominal_verdict(document: Document) -> Mapping[str, Any] | None:
    """Return the verdict on nominal driving, with its reasons; None if there is none."""
    return next((v for v in document.get("verdicts", []) if v["condition"] == "nominal"), None)


def train(document: Document) -> list[str]:
    """Count updates and steps in the twin, and show the success of the kept policy."""
    twin = f", {document['env_steps']:,} steps in the twin" if document["env_steps"] else ""
    lines = [f"{document['gradient_steps']:,} updates{twin}, {_format_time(document['wall_s'])}"]
    best = document["best"]
    if best is not None and best["success"]:
        cells = ", ".join(f"{name} {value:.2f}" for name, value in best["success"].items())
        lines.append(f"kept, by success on its own fixed episodes: {cells}")
    return lines


def driven(document: Document) -> list[str]:
    """Show success (or return) of each policy in the twin, with intervals by condition."""
    cells: dict[str, list[str]] = {}
    for row in document["results"]:
        text = f"return {row['return']:.2f}"
        if row["success"] is not None:
            text = interval_text(row["success"], row["success_low"], row["success_high"])
        if row["perturbation"] == "none":
            cells.setdefault(row["policy"], []).append(f"{row['condition']} {text}")
    lines = [f"{policy}: {', '.join(of)}" for policy, of in cells.items()]
    return lines + [clone["text"] for clone in document.get("clones", [])]


def on_logs(document: Document) -> list[str]:
    """Compare the policy's value, estimated on held-out logs, with what the drivers achieved."""
    shown: dict[str, list[str]] = {}
    for row in document["results"]:
        if row["condition"] == "all":
            measure = f"{row['measure']} of {counted(row['episodes'], 'held-out episode')}"
            words = ESTIMATORS.get(row["estimator"], row["estimator"])
            shown.setdefault(measure, []).append(f"{words} {_estimate(row)}")
    lines = [f"{measure}: {', '.join(of)}" for measure, of in shown.items()]
    return lines + list(document["notes"])


def _estimate(row: Mapping[str, Any]) -> str:
    if row["value"] is None:
        return f"refused: {row['refused']}"
    text = interval_text(row["value"], row["low"], row["high"])
    return text if row["low"] is not None else f"{text} (no interval)"


def errors(text: str) -> list[str]:
    """Return the errors that a verb printed on stderr, with remedies and without progress."""
    found: list[str] = []
    for line in text.splitlines():
        if line.startswith(_COMPLAINT):
            found.append(line.removeprefix(_COMPLAINT).strip())
        elif found and line.startswith("  "):
            found[-1] += f"; {line.strip()}"
    return found


_COMPLAINT = "restock: "


def _format_time(seconds: float) -> str:
    if seconds >= 5400:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 60:.1f} min" if seconds >= 90 else f"{seconds:.1f} s"
