"""Names of earlier versions -> what to write or type now. This module will be removed at 1.0.

A name that was removed without a replacement is not listed: it is an unknown key or option.
"""

from __future__ import annotations


def _now(name: str) -> str:
    return f"it is now called {name}: rename it"


_MEAN = "it was removed: restock export FOLDER --to run writes the mean of several runs"
_AT = "it was removed: name the version in the store's place, as in STORE@12"

TRAINING_KEYS = {
    "practice.shares": "it was removed: set the shares of kinds in env.conditions",
    "network.ensemble": _MEAN,
    "network.members": _MEAN,
    "loss.margin_policies": "it was removed: set teacher.policies",
    "evaluation.missions": "it was removed: a floor made from the logs starts where they did",
    "record.tensorboard": "it was removed: record.trackers names tensorboard, or does not",
}
STUDY_KEYS = {
    "space": "it was removed: call `restock train --set` from Optuna instead",
    "baseline": "it was removed: name the baseline's arm first",
    "evaluation.seed": "it was removed: set evaluation.seed in the settings instead",
}
MIXTURE_KEYS = {
    "held_out": _now("`evaluation_split`"),
    "planned": "write planned_draws = UPDATES x BATCH_SIZE in its place",
    "prefer": "it was removed: give the strata a `priority`, which decides",
    "sources.stores.version": _AT,
    "correction.beta": 'it was removed: use the rule "clipped"',
    **{
        f"{table}.{key}": "it was removed: set it for the whole mixture"
        for table in ("each_condition", "strata")
        for key in ("max_rows_per_episode", "max_rows_per_recording")
    },
}
MISSIONS_KEYS = {"store_version": _AT}
MIXTURES = {
    "missions": _now("'coverage'"),
    "exposure": 'it was removed: write `[each_condition]` with `kind = "exposure"` and'
    ' `unit = "episode"` into a file',
    "steps": 'it was removed: write `[each_condition]` with `share = "equal"` into a file',
}
AUDITS = {  # audits and their thresholds
    "flattering_evaluation": _now("'evaluation_bias'"),
    "flattering_panel": _now("'panel_bias'"),
    "flattering_policy": _now("'policy_bias'"),
    "observation_drift": _now("'signal_drift'"),
    "max_flattery": _now("'max_bias'"),
}

VERBS = {
    **{verb: f"it is `restock store {verb}` now" for verb in ("label", "compact", "remove")},
    **{verb: f"it is `restock coverage {verb}` now" for verb in ("gaps", "drift", "diff")},
    "record": "it is `restock twin record` now",
    "study": "it is `restock train STUDY.toml` now",
    "check": "`restock audit` takes its options now",
    "doctor": "it is `restock info` now, without a recording",
    "node": "it is a command of its own now: `restock-node`",
    "schema": "it is `restock profile schema` now",
}

OPTIONS = {  # "COMMAND --option", or "--option" for every command
    "coverage drift --out": "the page of `restock coverage STORE --out FILE` has drift, too",
    "--memory-limit": "set RESTOCK_MEMORY_LIMIT=4GB in the environment: every command keeps it",
    "audit --panel": "give the panel after the store: restock audit STORE PANEL",
    "audit --run": "give the run after the store: restock audit STORE RUN",
    "audit --summary": "send the output to the file: restock audit STORE >> FILE",
    "sql --panel": "give the panel after the store: restock sql STORE PANEL QUERY",
    "sql --run": "give the run after the store: restock sql STORE RUN QUERY",
    "coverage --every": "`restock coverage drift STORE --every month` prints other periods",
    "coverage --figures": "print the page, or query the store for a figure of your own",
    "compare --page": "`restock report FOLDER` writes the page of several runs",
    "report --figures": "print the page, or query the run for a figure of your own",
    "demo --logs": "`restock start BAGS --out DIR` takes recordings of your own",
    "demo --seconds": "it is --env-steps N now, the steps of each training",
    "demo --profile": "`restock start BAGS --out DIR` takes recordings of your own",
    "diagnose --before-training": "give the panel or store itself: restock diagnose PANEL",
    "eval --missions": "a floor of `restock twin layout --from STORE` starts where the logs did",
    "eval --baseline": "`restock gate RUN --baseline NAME` compares by episode, and decides",
    "eval --no-drive": "it is --episodes 0 now",
    "eval --save-as-baseline": "export the policy (--to onnx): `restock gate` takes the file",
    "export --license": "write `license: ID` at the top of the card, README.md",
    "export --panel": "give the panel after the store: restock export STORE PANEL",
    "coverage gaps --no-audits": "it is --thresholds none now",
    "twin layout --png": "give the picture to --out, too: --out floor.toml --out floor.png",
    "ingest --engine": "call restock.ingest.ingest in the cluster's tasks: docs/scale.md",
    "mix --verify": "it is `restock store verify PANEL` now",
    "profile schema --out": "send each to a file: restock profile schema NAME > FILE",
    "store label --all": "give the profile the name of the recordings' own",
    "store label --review": "`restock review STORE` shows the events on a page; --out review.csv",
    "store label --score": "query them: FROM pooled_label_scores, FROM label_reliability",
    "store label --out": "write the events with `restock review STORE --out review.csv`",
    "store label --corrections": "give the file to `restock review STORE FILE`",
    "store label --by": "query the scores of each recording: FROM label_scores",
    **{
        f"start {option}": "give it to `restock profile new`, and add --profile FILE.toml"
        for option in ("--footprint", "--robot", "--odometry-as-command")
    },
    "trace --panel": "trace the row where the panel is now: restock trace PANEL ROW",
    "trace --store": "trace the row where the store is now: restock trace STORE ID",
    **{
        f"twin {job} --profile": "ingest again with that profile: it reads no recording"
        for job in ("fit", "gap")
    },
    "twin gap --fit": "run `restock twin fit STORE --out FILE`, and give --perturbation FILE",
    "--version": "write the version after the store: STORE@12 or STORE@2026-11-01T08:00Z",
}
