"""Say what the names of earlier versions became: the only place that knows them. Goes at 1.0."""

from __future__ import annotations


def _now(name: str) -> str:
    return f"it is now called {name}: rename it"


def _fixed(value: str) -> str:
    return f"it was removed, and is always {value} now: leave it out"


_CAP = "it was removed: set it for the whole mixture"
_LEAST = "it was removed: leave the stratum out, or give it a smaller share"
_GONE = "it was removed, as it gained nothing (docs/evidence.md): leave it out"
_FIXED = "it was removed: its default always applies; leave it out"
_AT = "it was removed: name the version in the store's place, as in STORE@12"

TRAINING_KEYS = {
    "guard": _GONE,
    "guide": _GONE,
    "jump_start": _GONE,
    "offline_start": _GONE,
    "practice.floors": "it was removed: use practice.floor",
    "practice.half_life_episodes": _GONE,
    "practice.max_change": _GONE,
    "practice.reference": _GONE,
    "practice.reference_missions": _GONE,
    "practice.shares": "it was removed: set the shares of kinds in env.conditions",
    "network.dueling": _GONE,
    "network.ensemble": "it was removed: network.members is the mean of so many",
    "network.quantiles": _GONE,
    "loss.margin_policies": "it was removed: set teacher.policies",
    "loss.calibrated": _GONE,
    "env.overlap": _FIXED,
    "evaluation.averaging": _FIXED,
    "loss.conservative_online": _fixed("0"),
    "loss.conservative_steps": _FIXED,
    "loss.margin_size": _FIXED,
    "loss.margin_strata": _GONE,
    "loss.munchausen": _GONE,
    "loss.munchausen_floor": _GONE,
    "loss.munchausen_temperature": _GONE,
    "optimizer.max_grad_norm": _GONE,
    "practice.every_env_steps": _FIXED,
    "practice.warmup_episodes": _FIXED,
    "record.keep_checkpoints": _FIXED,
    "record.probe_rows": _FIXED,
    "record.tensorboard": "it was removed: record.trackers names tensorboard, or does not",
    "teacher.hidden": _FIXED,
    "teacher.learning_rate": _FIXED,
    "teacher.logs_share": _FIXED,
    "teacher.target": "it was removed: the target's maximum is always over plausible actions",
}
PROFILE_KEYS = {
    "clock.jump_s": _fixed("1 s"),
    "episodes.goal_moved_m": _fixed("0.01 m"),
    "episodes.plan_goal_tolerance_m": _fixed("0.5 m"),
    "goal.shortest_m": _fixed("3 goal radii"),
    "goal.wait_s": _fixed("10 s"),
}
STUDY_KEYS = {
    "space": "it was removed: call `restock train --set` from Optuna instead",
    "baseline": "it was removed: name the baseline's arm first",
    "rare": "it was removed: leave it out, as the rare conditions are those of the missions",
    "primary.baseline": "it was removed: it is the arm's own baseline",
    "evaluation.references": "it was removed: planner and operator drive once in every study",
    "evaluation.seed": "it was removed: set evaluation.seed in the settings instead",
    "power": "it was removed: compute the number of seeds before the study, and leave it out",
}
MIXTURE_KEYS = {
    "adaptive": _GONE,
    "held_out": _now("`evaluation_split`"),
    "prioritised.lap_alpha": _GONE,
    "prioritised.per_beta_batches": "it was removed: the exponent grows over 100,000 batches",
    "prioritised.per_epsilon": "it was removed: it is 0.001",
    "cut_at_off_policy": "it was removed: returns are always cut there",
    "planned": "write planned_draws = UPDATES x BATCH_SIZE in its place",
    "prefer": "it was removed: give the strata a `priority`, which decides",
    "sources.fresh": "it was removed: fresh rows get what is left",
    "sources.stores.version": _AT,
    "evaluation_split.gap_s": "it was removed: the gap is 2 s",
    "correction.beta": 'it was removed: use the rule "clipped"',
    **{
        f"{table}.{key}": instead
        for table in ("each_condition", "strata")
        for key, instead in {
            "min_rows": _LEAST,
            "min_episodes": _LEAST,
            "max_rows_per_episode": _CAP,
            "max_rows_per_recording": _CAP,
        }.items()
    },
}
MISSIONS_KEYS = {"store_version": _AT}
MIXTURES = {
    "missions": _now("'coverage'"),
    "exposure": 'it was removed: write `[each_condition]` with `kind = "exposure"` and'
    ' `unit = "episode"` into a file',
    "steps": 'it was removed: write `[each_condition]` with `share = "equal"` into a file',
}
AUDITS = {  # and their thresholds
    "flattering_evaluation": _now("'evaluation_bias'"),
    "flattering_panel": _now("'panel_bias'"),
    "flattering_policy": _now("'policy_bias'"),
    "observation_drift": _now("'signal_drift'"),
    "max_flattery": _now("'max_bias'"),
}

VERBS = {  # what to type instead
    **{verb: f"it is `restock store {verb}` now" for verb in ("label", "compact", "remove")},
    **{verb: f"it is `restock coverage {verb}` now" for verb in ("gaps", "drift", "diff")},
    "record": "it is `restock twin record` now",
    "study": "it is `restock train STUDY.toml` now",
    "check": "`restock audit` takes its options now",
    "doctor": "it is `restock info` now, without a recording",
    "node": "it is a command of its own now: `restock-node`",
    "schema": "it is `restock profile schema` now",
    "completion": "it is `restock --tyro-write-completion SHELL FILE` now",
}

OPTIONS = {  # of one command, or of all; what to type instead
    "coverage drift --out": "the page of `restock coverage STORE --out FILE` has drift, too",
    "--memory-limit": "set RESTOCK_MEMORY_LIMIT=4GB in the environment: every command keeps it",
    "audit --panel": "give the panel after the store: restock audit STORE PANEL",
    "audit --run": "give the run after the store: restock audit STORE RUN",
    "audit --summary": "send the output to the file: restock audit STORE >> FILE",
    "sql --panel": "give the panel after the store: restock sql STORE PANEL QUERY",
    "sql --run": "give the run after the store: restock sql STORE RUN QUERY",
    "coverage --every": "`restock coverage drift STORE --every month` prints other periods",
    "coverage --figures": "print the page, or query the store for a figure of your own",
    "demo --logs": "`restock start BAGS --out DIR` takes recordings of your own",
    "demo --profile": "`restock start BAGS --out DIR` takes recordings of your own",
    "diagnose --before-training": "give the panel or store itself: restock diagnose PANEL",
    "eval --baseline": "`restock gate RUN --baseline NAME` compares by episode, and decides",
    "demo --device": "leave it out: `restock train --device` takes a GPU",
    "eval --horizon": "leave it out: importance weights reach over all steps",
    "eval --no-drive": "it is --episodes 0 now",
    "eval --save-as-baseline": "export the policy (--to onnx): `restock gate` takes the file",
    "export --license": "write `license: ID` at the top of the card, README.md",
    "export --panel": "give the panel after the store: restock export STORE PANEL",
    "coverage gaps --no-audits": "it is --thresholds none now",
    "twin layout --png": "give the picture to --out, too: --out floor.toml --out floor.png",
    "coverage gaps --by": "leave it out: a cell is a condition, zone, action and robot",
    "gate --junit": "it is always RUN/gate/junit.xml",
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
    "trace --after": "leave it out: a view shows 5 s before and after the row",
    "trace --before": "leave it out: a view shows 5 s before and after the row",
    "trace --panel": "trace the row where the panel is now: restock trace PANEL ROW",
    "trace --profile": "leave it out: the store has the profile",
    "trace --store": "trace the row where the store is now: restock trace STORE ID",
    **{
        f"twin {job} --profile": "ingest again with that profile: it reads no recording"
        for job in ("fit", "gap")
    },
    "twin fit --base": "leave it out: the other parameters are nominal",
    "twin robot --friction": "leave it out: the floor's friction is 0.8",
    "twin gap --fit": "run `restock twin fit STORE --out FILE`, and give --perturbation FILE",
    "--version": "write the version after the store: STORE@12 or STORE@2026-11-01T08:00Z",
}
