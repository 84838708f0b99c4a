"""Shared robots, kind by kind: one profile, one store, the robot in the twin, a policy, judged.

    python benchmarks/robots.py --bags FOLDER --out DIR [--only TEXT] [--definitions PATH] [--json]

Recordings are grouped into kinds of robots by what they say themselves (command, odometry's frames,
lidar, description), never by their names. Each kind goes through `restock start` as a stranger's
would, without a hand, and with the twin even where it is not to be trusted (`--twin yes`; by
`--twin auto` such a kind is trained on its logs alone, and judged on those held out). Then its
drives are tagged, counted by robot and year, compared for drift, and, where a bumper is in the
recordings (and `--definitions` has the definition of its messages), its contacts score the labels.

All is kept under DIR: the same command goes on where it was interrupted, and does again only what
has changed. A `fleets.json` in FOLDER chooses the recordings, and its `robot` and `repo` are the
user's tags of robot and site; nothing else is taken from it.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness import finish, markdown, option_parser
from robot_contacts import ContactScore, contacts_of, score_contacts
from strangers import recordings_of

from restock.cli import main as restock
from restock.files import read_json, write_text
from restock.ingest import open_recording
from restock.ingest.propose.drives import robot_kinds, robot_traits
from restock.replay import Store
from restock.stats import interval_text

LISTED = "fleets.json"
TELLING = ("scan", "imu", "bumper", "goal", "plan", "wheels")  # of inputs that may be missing
DROVE = ("agent", "cloned", "planner")  # what came out, how the logs were driven, and a script
BY_YEAR = (
    "SELECT robot, site, year(logged_time) AS year, count(*) AS rows,"
    " count(DISTINCT episode_id) AS episodes, count(DISTINCT primary_condition) AS conditions"
    " FROM transitions GROUP BY ALL ORDER BY ALL"
)
Documents = Mapping[str, Any]  # stage of `restock start` -> what its verb printed


def main() -> int:
    parser = option_parser(__doc__)
    parser.add_argument("--bags", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--only", default="", metavar="TEXT", help="paths that hold this text")
    parser.add_argument("--minutes", type=float, default=3.0, help="of `restock start`, each kind")
    parser.add_argument("--twin", choices=("yes", "auto"), default="yes", help="as of start")
    parser.add_argument("--definitions", metavar="PATH", help="of the robots' own types")
    parser.add_argument("--kept", action="store_true", help="only what earlier calls left in DIR")
    options = parser.parse_args()
    paths = [path for path, _ in recordings_of(options.bags) if options.only in path.as_posix()]
    options.out.mkdir(parents=True, exist_ok=True)
    tags = user_tags(options.bags)
    robots = []
    for kind in kinds_of(paths, options.out / "kinds.json"):
        folder = options.out / kind.key
        print(f"{folder}: {kind.reported}", file=sys.stderr)
        if not options.kept:
            start(kind, folder, options.minutes, options.twin)
        if (folder / "start").is_dir():
            robots.append(measured(kind, folder, tags, options.definitions))
    return finish(options, {"robots": robots}, [], lines_of(robots))


@dataclass(frozen=True)
class Kind:
    """One kind of robot, in its own words, and its recordings."""

    reported: str
    paths: tuple[str, ...]

    @property
    def key(self) -> str:
        return hashlib.blake2b(self.reported.encode(), digest_size=4).hexdigest()


def kinds_of(paths: Sequence[Path], kept: Path) -> list[Kind]:
    """Return the recordings by kind of robot; what an earlier call found of these files is kept."""
    files = [[str(path), path.stat().st_size] for path in paths]
    if kept.is_file() and (known := read_json(kept))["files"] == files:
        return [Kind(one["told"], tuple(one["paths"])) for one in known["kinds"]]
    traits = []
    for path in paths:
        with open_recording(path) as recording:
            traits.append(robot_traits(recording))
    kinds = []
    for members in robot_kinds(traits):
        reported = max((str(traits[one]) for one in members), key=len)
        kinds.append(Kind(reported, tuple(str(paths[one]) for one in members)))
    rows = [{"told": kind.reported, "paths": kind.paths} for kind in kinds]
    write_text(kept, json.dumps({"files": files, "kinds": rows}, indent=1) + "\n")
    return kinds


def user_tags(bags: Path) -> dict[str, dict[str, str]]:
    """Robot and site of each recording, as a user would know them; none without a list."""
    listed = bags / LISTED
    if not listed.is_file():
        return {}
    return {
        str(bags / one["file"]): {"robot": one["robot"], "site": one["repo"]}
        for one in json.loads(listed.read_text())
    }


def start(kind: Kind, folder: Path, minutes: float, twin: str) -> None:
    """Run the whole of `restock start`; what it prints is kept in the folder."""
    flags = ["--out", str(folder), "--twin", twin, "--accept", "--minutes", f"{minutes:g}"]
    write_text(folder / "start.txt", said(["start", *kind.paths, *flags]))


def said(command: Sequence[str]) -> str:
    """Return what a verb prints."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        restock(list(command))
    return printed.getvalue()


def measured(
    kind: Kind, folder: Path, tags: Mapping[str, Mapping[str, str]], definitions: str | None
) -> dict[str, Any]:
    """Return the figures of one kind, from what `restock start` left."""
    stages = read_json(folder / "start" / "stages.json")
    documents = {
        name: json.loads(file.read_text(encoding="utf-8"))
        for name in stages
        if (file := folder / "start" / f"{name}.json").is_file()
    }
    figures = {
        "robot": kind.reported,
        "recordings": len(kind.paths),
        "minutes_it_took": round(sum(one.get("seconds") or 0 for one in stages.values()) / 60, 1),
        "stopped": "; ".join(documents.get("propose", {}).get("problems", [])),
        "stages": {
            name: [*one["outcome"], *one["errors"]]
            for name, one in stages.items()
            if one["status"] not in ("begun", "planned")
        },
        **rows_of(documents),
        **twin_of(stages, documents),
        **policy_of(stages, documents),
    }
    store = folder / "store"
    if not store.is_dir():
        return figures
    profile = ["--profile", str(folder / "profile.toml"), "--store", str(store), "--json"]
    for path in kind.paths:
        words = [word for tag in tags.get(path, {}).items() for word in ("--tag", "=".join(tag))]
        if words:
            said(["ingest", path, *profile, *words])
    figures["by_year"] = json.loads(said(["sql", str(store), BY_YEAR, "--json"]))
    drift = json.loads(said(["coverage", "drift", str(store), "--json"]))
    figures["drift"] = {
        "tests": dict(Counter(f"{one['against']}: {one['verdict']}" for one in drift["tests"])),
        "findings": [one["finding"] for one in drift["findings"]],
        "notes": drift["notes"],
    }
    figures["contacts"] = contacts_against_labels(kind, store, definitions)
    return figures


def rows_of(documents: Documents) -> dict[str, Any]:
    """Return rows, time, conditions and stand-ins for what was missing."""
    recordings = documents.get("ingest", {}).get("recordings", [])
    good = [one for one in recordings if one["status"] != "failed"]
    coverage = documents.get("coverage", [])
    stood_in: Counter[str] = Counter(
        f"{item['input']}: {item['instead']}"
        for one in good
        for item in one["stand_ins"]
        if item["input"] in TELLING
    )
    return {
        "with_rows": len(good),
        "recorded_min": round(sum(one["duration_s"] for one in good) / 60, 1),
        "rows": sum(one["transitions"] for one in good),
        "episodes": sum(one["episodes"] for one in good),
        "conditions": {one["condition"]: one["rows_held"] for one in coverage if one["rows_held"]},
        "stood_in": dict(stood_in),
        "repeats": [one["path"] for one in good if one["repeats"]],
        "failed_audits": [
            one["audit"]
            for one in documents.get("audit", {}).get("audits", [])
            if one["status"] == "fail"
        ],
    }


def twin_of(stages: Documents, documents: Documents) -> dict[str, Any]:
    """Return how the robot was fitted, and how far it ends from nominal driving."""
    fits = documents.get("fit", {}).get("fits", [{"estimates": [], "warnings": []}])[0]
    gap = documents.get("gap", {"paths": [], "verdicts": []})
    ends = {}
    for one in gap["paths"]:
        if (one["condition"], one["quantity"]) == ("nominal", "position"):
            interval = one["median_low"], one["median_high"]
            ends[one["source"]] = interval_text(one["median"], *interval)
    return {
        "fitted": {
            one["name"]: interval_text(one["value"], one["low"], one["high"], ".3g")
            for one in fits["estimates"]
            if one["fitted"]
        },
        "not_told": {one["name"]: one["note"] for one in fits["estimates"] if not one["fitted"]},
        "warnings": fits["warnings"],
        "gap_m": ends,
        "verdicts": {
            one["condition"]: f"{one['verdict']} ({one['segments']} segments)"
            for one in gap["verdicts"]
        },
        "why": next(
            (one["reasons"] for one in gap["verdicts"] if one["condition"] == "nominal"), []
        ),
    }


def policy_of(stages: Documents, documents: Documents) -> dict[str, Any]:
    """Return success in the twin by policy (`cloned` is how the logs were driven).

    With it come how good the clone is, and what held-out logs say.
    """
    driven: dict[str, dict[str, str]] = {}
    for one in documents.get("eval", {}).get("results", []):
        if one["perturbation"] == "none" and one["success"] is not None:
            ends = one["success_low"], one["success_high"]
            driven.setdefault(one["policy"], {})[one["condition"]] = interval_text(
                one["success"], *ends
            )
    return {
        "driven": driven,
        "clones": [one["text"] for one in documents.get("eval", {}).get("clones", [])],
        "on_logs": stages.get("judge", {}).get("outcome", []),
    }


def contacts_against_labels(kind: Kind, store: Path, definitions: str | None) -> dict[str, Any]:
    """Return how labels made without the bumper fare against it; empty where there is none."""
    contacts = {}
    for path in kind.paths:
        with open_recording(path, definitions=definitions) as recording:
            if (found := contacts_of(recording)) is not None:
                contacts[path] = found
    if not contacts:
        return {}
    with Store(store) as opened:
        score: ContactScore = score_contacts(opened, contacts)
    return score.document()


def lines_of(robots: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the tables."""
    header = [
        *("robot, by its own words", "recordings", "rows", "conditions", "stood in"),
        *("fitted", "gap after 3 s, m", "twin in nominal driving", *DROVE),
        *("how good the clone is", "on held-out logs", "min"),
    ]
    table = []
    for one in robots:
        share = f"{one['with_rows']} of {one['recordings']}, {one['recorded_min']:g} min"
        gap = one["gap_m"]
        table.append(
            [
                one["robot"],
                share,
                f"{one['rows']:,} in {one['episodes']}",
                _pairs(one["conditions"], "{0} {1:,}"),
                ", ".join(item.partition(":")[0] for item in one["stood_in"]) or one["stopped"],
                _pairs(one["fitted"], "{0} {1}") or "nothing",
                " -> ".join(gap[name] for name in ("nominal", "calibrated") if name in gap),
                one["verdicts"].get("nominal", "not measured"),
                *(_pairs(one["driven"].get(who, {}), "{0} {1}") for who in DROVE),
                "; ".join(one["clones"]),
                "; ".join(one["on_logs"]),
                one["minutes_it_took"],
            ]
        )
    lines = [markdown(header, table), ""]
    for one in robots:
        lines += [f"## {one['robot']}", ""]
        if rows := one.get("by_year"):
            lines += [BY_YEAR, "", markdown(list(rows[0]), [row.values() for row in rows]), ""]
        lines += [f"failed audits: {', '.join(one['failed_audits']) or 'none'}"]
        lines += [f"{path} repeats another recording" for path in one["repeats"]]
        lines += [f"fit: {warning}" for warning in one["warnings"]]
        lines += [f"gap: {why}" for why in one["why"]]
        if drift := one.get("drift"):
            lines += [f"drift: {_pairs(drift['tests'], '{0} {1}')}"]
            lines += [f"drift: {each}" for each in (*drift["findings"], *drift["notes"])]
        lines += [f"contacts: {name}: {value}" for name, value in one.get("contacts", {}).items()]
        lines += [""]
    return lines


def _pairs(values: Mapping[str, Any], form: str) -> str:
    return ", ".join(form.format(name, value) for name, value in values.items())


if __name__ == "__main__":
    sys.exit(main())
