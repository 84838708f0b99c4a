"""The story that the demo tells around its stages: what to expect, and the results.

All of it is read from what the stages wrote: the panel, the runs' tables, the store's rows and the
recording's messages.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from restock.cli.start.stages import Settings, fed_uniformly, from_logs_alone
from restock.stats import wilson
from restock.words import policy_words, quoted

if TYPE_CHECKING:
    from restock.replay.panel.panel import Panel
    from restock.replay.trace.trace import Trace

OPENING = """\
Recordings of a robot in a warehouse become a policy. Most of the driving is in
an easy aisle. Wet floors, blocked aisles and people who step out are rare, and
a learner hardly sees them.

  1. Recordings become rows, each labelled with what happened at that moment.
  2. Rare conditions get quotas, so that every batch contains all of them.
  3. A network learns from the logs alone: the policy before fine-tuning.
  4. Another one continues in a simulation, the twin: the policy after it.
  5. A third one continues, too, but is fed uniformly, with the logs as they are.
  6. All drive the same missions as the robot's scripted planner.

At the end you see the policies before and after, what the critic was fed of
each condition, one rare event followed from the recording's message
to the update that learned from it, and what to try with your own recordings."""

_CELLS = 30  # length of a bar of 100 %
RARE = "all rare ones"
FULL_STEPS = 128_000  # in docs/evidence.md


def before_and_after(to: Settings) -> list[dict[str, str]]:
    """Count the missions of each kind that succeeded, before and after fine-tuning.

    Beside these stand the policy fed uniformly and the planner, all on the floor that was trained
    on. Empty if the task has no goal: nothing succeeds or fails.
    """
    from restock.train.run.kept_evaluations import shown_evaluation

    rows = shown_evaluation(to.run)[0].to_pylist()
    uniform = fed_uniformly(to)
    names = policy_words([from_logs_alone(to), uniform, "agent", "planner"])
    driven = {
        name: [row for row in rows if row["policy"] == policy and row["perturbation"] == "none"]
        for policy, name in names.items()
    }
    if not driven[names[uniform]]:
        del driven[names[uniform]]
    if any(row["success"] is None for rows in driven.values() for row in rows):
        return []
    kinds = sorted(
        {row["condition"] for rows in driven.values() for row in rows},
        key=lambda kind: (kind != "nominal", kind),
    )
    return [
        {"mission": kind} | {name: _arrived(rows, kind) for name, rows in driven.items()}
        for kind in [*kinds, RARE]
    ]


def _arrived(rows: Sequence[dict[str, Any]], kind: str) -> str:
    """Count missions of a kind that arrived without a contact, with a 95 % interval."""
    of = [
        bool(row["success"])
        for row in rows
        if row["condition"] == kind or (kind == RARE and row["condition"] != "nominal")
    ]
    if not of:
        return ""
    low, high = wilson(sum(of), len(of))
    return f"{sum(of)} of {len(of)} [{100 * low:.0f}, {100 * high:.0f}]"


def trained(to: Settings) -> str:
    """Say how far fine-tuning came, and how the other policy was fed."""
    from restock.train.run.run import Run

    steps: list[int] = Run.open(to.run).table("progress")["env_steps"].to_pylist()
    most = max(steps, default=0)
    lines = [f"The agent is the fine-tuned policy: {most:,} steps in the twin here."]
    if most < FULL_STEPS / 2:
        lines += [
            f"That is little: docs/evidence.md says what {FULL_STEPS:,} steps gave. Give more",
            "--seconds, or run nothing else beside it.",
        ]
    if not most:
        lines = ["The time was up before anything was driven: give more --seconds."]
    if to.uniform.is_dir():
        lines += [
            "Fed uniformly has the same network, settings and seed"
            + (", as many steps, and every" if most else ", and every"),
            "row of the logs has the same probability. This compares feeds, not methods, so",
            f"`restock compare {quoted(to.uniform)} {quoted(to.run)}` refuses",
            "(unless --treatment mixture is given). One seed each is a sample of one:",
            "docs/evidence.md has ten.",
        ]
    return "\n".join(lines)


def shelves(run: Path) -> list[str]:
    """Return a line a stratum: its share of the logs, its quota, and what the critic was fed."""
    from restock.train.run.fed_shares import fed_shares, shortfalls
    from restock.train.run.run import Run
    from restock.train.run.run_profile import run_panel

    trained = Run.open(run)
    panel: Panel | None = run_panel(trained.document)
    fed = fed_shares(trained)
    if panel is None or not fed:
        return []
    logged = {stratum.name: stratum.natural_share for stratum in panel.strata}
    width = max(len(row["stratum"]) for row in fed)
    lines = [f"{'stratum':<{width}}  in the logs  wanted    fed  of it logged, fresh"]
    for row in fed:
        of_logs = logged.get(row["stratum"], 0.0)
        natural, drawn = (round(_CELLS * s) for s in (of_logs, row["drawn_share"]))
        bar = "█" * min(natural, drawn) + "▒" * (drawn - natural) + "·" * (natural - drawn)
        lines.append(
            f"{row['stratum']:<{width}}  {of_logs:>11.1%}  {row['wanted_share']:>6.1%}"
            f"  {row['drawn_share']:>5.1%}  {row['logs_share']:>9.1%}, {row['fresh_share']:>5.1%}"
            f"  {bar}".rstrip()
        )
    return [
        *lines,
        "█ as in the logs   ▒ added by quota   · less than in the logs",
        f"In % of all {sum(row['drawn_rows'] for row in fed):,} rows that the critic was fed"
        " (`FROM fed` of the run).",
        *(f"warning: {line}" for line in shortfalls(fed)),
    ]


def films(to: Settings) -> list[str]:
    """Return where the films are, with the failing policy beside the fine-tuned one."""
    from restock.train.evaluation.film import FOLDER

    found = sorted((to.run / FOLDER).glob("*-rescue.webp"))
    reported = (
        ["The policy that failed is on the left; the report shows them, too."] if found else []
    )
    return [*map(str, found), *reported]


def rare_event(to: Settings) -> list[str]:
    """Follow a logged row of a rare condition from its message to an update, if there is one."""
    row = _chosen(to.run)
    if row is None:
        return []
    from restock.errors import RestockError
    from restock.replay.trace.trace import TracePlaces, trace_row

    name = f"{row['gradient_step']}/{row['batch_row']}"
    trace = trace_row(to.run, name)
    recording = trace.origin.transition["source_file"] if trace.origin is not None else ""
    command = f"restock trace {quoted(to.run)} {name}"
    if recording and Path(recording).exists():
        command += f" --recording {quoted(recording)}"
        with suppress(RestockError):  # one that changed since is no reason to end the demo
            trace = trace_row(to.run, name, TracePlaces(recording=Path(recording)))
    return [*_told(trace, to), f"All of it: {command}"]


def _chosen(run: Path) -> dict[str, Any] | None:
    """Return the audited logged row of the rarest condition with the largest TD error."""
    from restock.train.run.run import Run

    audit: list[dict[str, Any]] = Run.open(run).table("audit").to_pylist()
    rows = [
        row
        for row in audit
        if row["source"] == "logs" and row["condition"] not in (None, "nominal", "unlabelled")
    ]
    if not rows:
        return None
    often: dict[str, int] = {}
    for row in rows:
        often[row["condition"]] = often.get(row["condition"], 0) + 1
    rarest = min(often, key=lambda condition: (often[condition], condition))
    return max(
        (row for row in rows if row["condition"] == rarest),
        key=lambda row: (abs(row["td"]), row["gradient_step"]),
    )


def _told(trace: Trace, to: Settings) -> list[str]:
    """Write the chain, with a line or two for each link."""
    from restock.replay.panel.panel import Panel
    from restock.train.run.fed_shares import fed_shares
    from restock.train.run.run import Run

    assert trace.audit is not None
    audit, origin, lines = trace.audit, trace.origin, []
    if origin is not None:
        moment = origin.moment["log_time"].replace("T", " ").split("+")[0]
        lines.append(f"recording  {origin.transition['source_file']}, {moment} UTC")
        for message in origin.messages:
            if said := _message(message.input, message.fields):
                lines.append(f"message    {message.topic}, {message.age_s:.2f} s before: {said}")
    panel = Panel.open(to.panel)
    stratum = next(stratum for stratum in panel.strata if stratum.name == audit["stratum"])
    ended = ", and its episode ends here" if audit["discount"] == 0 else ""
    drawn, even = _draws(to.run, panel, audit["episode"])
    fed = next(row for row in fed_shares(Run.open(to.run)) if row["stratum"] == audit["stratum"])
    target = audit["q"] - audit["td"]
    return [
        *lines,
        f"row        {audit['transition_id']}, driven by the {audit['behaviour_policy']}",
        f"           labelled {audit['condition']}; reward {audit['reward']:.2f}{ended}",
        f"stratum    {stratum.name}: {stratum.natural_share:.1%} of the logs,"
        f" {fed['drawn_share']:.1%} of the rows fed ({fed['logs_share']:.1%} logged)",
        f"           its episode's rows were drawn {drawn:,} times; with equal probability: "
        f"{even:,.0f}",
        f"update     {audit['gradient_step']:,}, row {audit['batch_row']} of its batch",
        f"           the critic predicted {audit['q']:.2f}, its target was {target:.2f}",
    ]


def _draws(run: Path, panel: Panel, episode: str) -> tuple[int, float]:
    """Count how often an episode's rows were drawn, and how often uniform draws would have."""
    from restock.train.run.run import Run

    logged = [
        row
        for row in Run.open(run).table("sampled_episodes").to_pylist()
        if row["source"] == "logs"
    ]
    drawn = sum(row["drawn_rows"] for row in logged if row["episode"] == episode)
    share = float((panel.meta_column("episode_id") == episode).mean())
    return drawn, share * sum(row["drawn_rows"] for row in logged)


def _message(name: str, fields: dict[str, Any]) -> str:
    """Summarize a message in a few words; "" if that would say little here."""
    if name == "scan":
        ranges = [r for r in fields.get("ranges", ()) if r is not None and math.isfinite(r)]
        return f"the nearest return is {min(ranges):.2f} m away" if ranges else "no return"
    if name == "command":
        return (
            f"asked for {fields.get('linear.x', 0.0):.2f} m/s and"
            f" {fields.get('angular.z', 0.0):.2f} rad/s"
        )
    return ""


def next_steps(to: Settings) -> list[str]:
    """List what to try on one's own logs: a command, and what it does."""
    run, store = to.run, to.store
    return [
        "restock start BAG --out mine",
        "    the same stages on your own bag or MCAP file; it proposes how topics become signals",
        f'restock sql {quoted(store)} "FROM coverage_by_condition"',
        "    your questions, in SQL: docs/sql.md lists tables and columns",
        f"restock coverage gaps {quoted(store)} --mixture coverage",
        "    what the logs lack, and which missions would fill the gaps",
        f"restock diagnose {quoted(run)}",
        "    why a critic fails: because of what it was fed, or of its target?",
        "docs/tutorial.md, docs/your-robot.md",
        "    what replay and target do, cell by cell; your robot, from bags to a policy",
    ]


__all__ = [
    "OPENING",
    "RARE",
    "before_and_after",
    "films",
    "next_steps",
    "rare_event",
    "shelves",
    "trained",
]
