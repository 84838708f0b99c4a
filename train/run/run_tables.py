"""The Parquet tables of a run directory: their columns, types and meanings.

Every table is there from the first flush on, if only with no rows, so that a reader of a young or
killed run finds what it expects. The meanings go into the files: `restock sql RUN "FROM columns"`
lists them, and `python -m restock.train.run.run_tables docs/run.md` writes them into the page.
"""

from __future__ import annotations

import sys
from pathlib import Path

import pyarrow as pa

from restock.ingest.task.perturbation_columns import VALUES

BEGIN = "<!-- tables: written by `python -m restock.train.run.run_tables docs/run.md` -->"
END = "<!-- end of tables -->"

_F, _I, _S, _B = pa.float64(), pa.int64(), pa.string(), pa.bool_()
_STEPS = [
    ("env_steps", _I, "environment steps so far, all environments together"),
    ("gradient_steps", _I, "updates so far"),
]
_MEASURES = [
    ("discounted_return", _F, "from the first step, by the run's `loss.discount`"),
    ("distance_m", _F, "driven, over ground"),
    ("closest_person_m", _F, "least true distance to a person or forklift; null: nobody about"),
]


def _schema(doc: str, *columns: tuple[str, pa.DataType, str]) -> pa.Schema:
    fields = [pa.field(name, kind, metadata={"meaning": text}) for name, kind, text in columns]
    return pa.schema(fields, metadata={"doc": doc})


TABLES: dict[str, pa.Schema] = {
    "progress": _schema(
        "a logging interval: the two clocks, the loss, exploration, target lag, speed",
        *_STEPS,
        ("wall_s", _F, "training time so far, without the time between a kill and a resume"),
        ("phase", _S, "offline | warmup | online"),
        ("updates", _I, "gradient steps in the interval"),
        ("loss", _F, "mean of an update"),
        ("td_abs_mean", _F, "mean |Q(s, a) - target| of the rows drawn"),
        ("q_mean", _F, "mean Q of the actions taken"),
        ("q_abs_max", _F, "the largest |Q| of an action taken"),
        ("reward_mean", _F, "of the rows drawn (n-step returns)"),
        ("epsilon", _F, "probability of a random action; null while offline"),
        ("target_rule", _S, "how the target network follows, in words"),
        ("target_param_distance", _F, "|online - target| / |online|, over all parameters"),
        ("target_q_lag", _F, "mean |Q - Q_target| / mean |Q| on the probe"),
        ("target_sampled", _S, "when the two above were measured: now | before_sync (hard rule)"),
        ("last_sync", _I, "gradient step after which the target last moved"),
        ("steps_since_sync", _I, "gradient steps since then"),
        ("logs_share", _F, "of the rows drawn, those from logs"),
        ("ring_rows", _I, "fresh rows kept"),
        ("episodes", _I, "finished in the interval, while exploring"),
        ("success", _F, "share of those that reached the goal without a bump; null: no goal"),
        ("return_mean", _F, "of those, undiscounted"),
        ("env_steps_per_s", _F, "over the interval"),
        ("updates_per_s", _F, "over the interval"),
    ),
    "strata": _schema(
        "an interval x source x stratum: what the critic was fed",
        *_STEPS,
        ("phase", _S, "offline | warmup | online"),
        ("source", _S, "logs | fresh"),
        ("stratum", _S, "of that source"),
        ("timing", _S, "pre | post the outcome, of a stratum of the logs"),
        ("quota_share", _F, "of the logged rows, as the mixture asks; null without a quota"),
        ("available_rows", _I, "in the panel, or in the ring now"),
        ("available_share", _F, "of the source's rows"),
        ("drawn_rows", _I, "in the interval"),
        ("drawn_share", _F, "of the source's drawn rows"),
        ("effective_share", _F, "the same after importance weights"),
        ("unique_rows", _I, "different rows among those drawn"),
        ("replays_per_row", _F, "drawn_rows / unique_rows"),
        ("total_drawn_rows", _I, "since the run began"),
        ("td_abs_mean", _F, "mean |Q(s, a) - target| of the rows drawn"),
        ("q_mean", _F, "mean Q of the actions taken"),
        ("reward_mean", _F, "mean n-step return"),
        ("terminal_share", _F, "of the rows drawn, those that do not bootstrap"),
    ),
    "conditions": _schema(
        "an interval x source x condition: what batches held of each",
        *_STEPS,
        ("phase", _S, "offline | warmup | online"),
        ("source", _S, "logs | fresh"),
        ("condition", _S, "whatever the strata are"),
        ("drawn_rows", _I, "in the interval"),
        ("drawn_share", _F, "of the source's drawn rows"),
        ("effective_share", _F, "the same after importance weights"),
        ("td_abs_mean", _F, "mean |Q(s, a) - target| of the rows drawn"),
        ("q_mean", _F, "mean Q of the actions taken"),
    ),
    "actions": _schema(
        "an interval x source x stratum x condition x action: what batches held, what is wanted",
        *_STEPS,
        ("phase", _S, "offline | warmup | online"),
        ("source", _S, "logs | fresh"),
        ("stratum", _S, "of that source"),
        ("condition", _S, "of the drawn rows"),
        ("action", pa.int16(), "index of the discrete action, those never drawn too"),
        ("name", _S, "of the action"),
        ("drawn_rows", _I, "in the interval"),
        ("drawn_share", _F, "of the rows drawn of that stratum and condition"),
        ("unique_rows", _I, "different rows among those drawn"),
        ("audited_rows", _I, "of that stratum and condition, in audited batches"),
        ("greedy_rows", _I, "of those, where the policy of that moment would take this action"),
        ("greedy_share", _F, "greedy_rows / audited_rows; null without audited rows"),
    ),
    "shares": _schema(
        "an interval x stratum of the logs: the share in force, and how often rows were drawn",
        *_STEPS,
        ("source", _S, "logs, or the name of another store of the mixture"),
        ("stratum", _S, "of the logs"),
        ("share", _F, "of the logged rows of a batch, in force at the interval's end"),
        ("planned_share", _F, "as the run began"),
        ("logs_share", _F, "of an online batch, all logged rows together"),
        ("rows", _I, "in the panel"),
        ("drawn_rows", _I, "since the run began"),
        ("replays_per_row", _F, "drawn_rows / rows"),
        ("replays_max", _I, "most draws of one row; null where nothing limits them"),
        ("max_replays_per_row", _I, "the limit"),
        ("replaced_rows", _I, "draws beyond the limit that were given to other rows"),
        ("exhausted", _B, "every row had all its draws: other strata have its share"),
    ),
    "ages": _schema(
        "an interval x source x unit x log2 bucket: how old the drawn rows were",
        *_STEPS,
        ("source", _S, "logs | fresh"),
        ("unit", _S, "days for logs; env_steps and gradient_steps for fresh rows"),
        ("bucket", pa.int32(), "ages in [2**bucket, 2**(bucket + 1)); -1: below 1"),
        ("count", _I, "rows drawn"),
        ("p50", _F, "median age, over all buckets"),
        ("p90", _F, "90th percentile"),
        ("p99", _F, "99th percentile"),
    ),
    "sampled_episodes": _schema(
        "an interval x source x stratum x episode: how often it was drawn",
        *_STEPS,
        ("source", _S, "logs | fresh"),
        ("stratum", _S, "of that source"),
        ("episode", _S, "of logs: episode_id; fresh: the ring's key"),
        ("drawn_rows", _I, "in the interval"),
        ("weight", _F, "the sum of their importance weights"),
    ),
    "policies": _schema(
        "an interval x source x behaviour policy of the drawn rows",
        *_STEPS,
        ("source", _S, "logs | fresh"),
        ("behaviour_policy", _S, "who acted"),
        ("rows", _I, "drawn in the interval"),
    ),
    "probe": _schema(
        "an interval x condition: the critic on a fixed set of rows",
        *_STEPS,
        ("source", _S, "logs | fresh: where the fixed rows are from"),
        ("condition", _S, "of the fixed rows"),
        ("rows", _I, "fixed rows of the condition"),
        ("td_abs_mean", _F, "mean |Q(s, a) - target|"),
        ("q_mean", _F, "mean Q of the actions taken"),
        ("q_lag", _F, "mean |Q - Q_target| / mean |Q|"),
        ("probe_hash", _S, "of the fixed rows: runs compare, and resume, where it is the same"),
    ),
    "evaluation_buffer": _schema(
        "an evaluation x condition: the critic on its steps, which are in no replay",
        *_STEPS,
        ("condition", _S, "of the evaluation's steps"),
        ("rows", _I, "on which the critic was measured"),
        ("rows_met", _I, "all of them: how often driving meets the condition"),
        ("td_abs_mean", _F, "mean |Q(s, a) - target|"),
        ("td_online_abs_mean", _F, "the same as if the online network bootstrapped"),
        ("explained", _F, "1 - Var(TD) / Var(target): below 0 a constant would be nearer"),
        ("q_abs_mean", _F, "mean |Q| of the actions taken"),
        ("q_lag", _F, "mean |Q - Q_target| / mean |Q|"),
        (
            "logs_agreement",
            _F,
            "share of the logs' rows of the condition that these steps and the ring's confirm",
        ),
        ("logs_unexplained", _F, "of the variance of their next observations, left unexplained"),
    ),
    "off_policy": _schema(
        "a measure x condition x estimator: the offline policy on held-out logs",
        *_STEPS,
        ("measure", _S, "return | success"),
        ("condition", _S, "of the episode, or all"),
        ("estimator", _S, "logged | fqe | pdwis | wdr"),
        ("value", _F, "the estimate; null where it is refused"),
        ("low", _F, "lower end of its 95 % interval, over episodes; null of fqe"),
        ("high", _F, "upper end"),
        ("refused", _S, "why, or null"),
        ("episodes", _I, "of the logs"),
        ("ess", _F, "the least that weights are worth at a step, in episodes"),
        ("ess_steps", _I, "for how many first steps they are worth enough"),
        ("steps", _I, "of the longest episode"),
        ("horizon", _I, "steps that are weighted; null: all"),
        ("epsilon", _F, "of the greedy policy made soft"),
        ("discount", _F, "of one step"),
        ("estimated_share", _F, "of rows whose behaviour probability was cloned, not logged"),
    ),
    "offline_start": _schema(
        "a policy that might have driven first x all, nominal and rare episodes of held-out logs",
        *_STEPS,
        ("candidate", _S, "as learnt | values | filtered RATIO | cloned | proposed | proposed, …"),
        ("chosen", pa.bool_(), "it drove until online updates began"),
        ("measure", _S, "success | return (without a goal)"),
        ("condition", _S, "nominal | rare (an episode that met a condition) | all: their mean"),
        ("value", _F, "weighted doubly robust over the first `reach` steps, then the model"),
        (
            "low",
            _F,
            "lower end of its 95 % interval, over episodes; the largest of `all` is chosen",
        ),
        ("high", _F, "upper end"),
        ("refused", _S, "why its bound is not trusted, or null"),
        ("model", _F, "fitted Q evaluation alone"),
        ("episodes", _I, "of the logs"),
        ("ess", _F, "the least that weights are worth at a step, in episodes"),
        ("reach", _I, "first steps for which they are worth enough; of all: the least"),
        ("estimated_share", _F, "of rows whose behaviour probability was cloned, not logged"),
    ),
    "guard": _schema(
        "an evaluation x condition in which the guard saw a fall, and what was done",
        *_STEPS,
        ("condition", _S, "in which success fell"),
        ("best", _F, "success of the kept policy"),
        ("now", _F, "success of this evaluation"),
        ("action", _S, "stop | rollback"),
    ),
    "episodes": _schema(
        "a finished training episode (the agent explores in them)",
        *_STEPS,
        ("episode", _I, "the ring's key"),
        ("env", pa.int32(), "the environment it ran in"),
        ("episode_seed", _I, "with true_condition and perturbation, what lays it out again"),
        ("perturbation", _S, "its name"),
        ("layout", _S, "of the floor"),
        ("perturbation_values", VALUES, "those that are not nominal"),
        ("true_condition", _S, "the kind of episode that the twin drew"),
        ("block", _S, "none | partial | full"),
        ("conditions", pa.list_(_S), "labels that held at some step, as the robot can sense"),
        ("return", _F, "undiscounted"),
        ("success", _B, "at the goal without a bump; null: no goal"),
        ("bumps", _I, "times that it began to touch something"),
        ("steps", _I, "of the episode"),
        ("time_s", _F, "of the episode, simulated"),
    ),
    "practice": _schema(
        "an interval of practice x arm: the missions that the twin was to give, and gave",
        *_STEPS,
        ("rule", _S, "natural | even | shares | logs | missions | success | regret"),
        ("arm", _S, "the kind of missions, with its block, floor or part of a range"),
        ("condition", _S, "the arm's kind of episode"),
        ("natural_share", _F, "of the missions, as `env` says"),
        ("wanted_share", _F, "in force in the interval"),
        ("given_share", _F, "of the episodes that ended in it; null where none did"),
        ("episodes", _I, "that ended in it, while exploring"),
        ("success", _F, "of those; null where none ended"),
        ("success_rate", _F, "over its fading episodes; null: too few to be believed"),
        ("reference", _F, "success of whom regret is against; null under other rules"),
        ("weight", _F, "what the rule goes by, before floors and the limit of change"),
        ("total_episodes", _I, "of the arm since the run began"),
    ),
    "teacher": _schema(
        "an interval x source x condition: what the teacher's filter did in a sample of states",
        *_STEPS,
        ("source", _S, "logs: cloned rows | fresh: rows of the ring"),
        ("condition", _S, "of those rows"),
        ("ratio", _F, "in force: an action is plausible from this share of the likeliest's on"),
        ("rows", _I, "that were looked at, at random"),
        ("asked_rows", _I, "of those, in which the teacher gave an action"),
        ("loss", _F, "mean -log G(a|s) of its action; null where it gave none"),
        ("agreement", _F, "share in which its action is the likeliest of the behaviour network"),
        ("plausible_actions", _F, "mean number of plausible actions"),
        ("teacher_plausible", _F, "share in which its action is plausible"),
        ("changed", _F, "share in which the filter changed the choice of Q"),
        ("chosen_agreement", _F, "share in which the choice, filtered, is its action"),
    ),
    "audit": _schema(
        "a drawn row of a seeded sample of batches",
        ("gradient_step", _I, "whose batch it was in"),
        ("batch_row", pa.int32(), "its place in the batch"),
        ("source", _S, "logs | fresh"),
        ("transition_id", _I, "of a logged row: joins the store's transitions"),
        ("panel_row", _I, "of a logged row"),
        ("ring_slot", _I, "of a fresh row"),
        ("episode", _S, "of logs: episode_id; fresh: the ring's key"),
        ("episode_step", _I, "of a fresh row; of a logged one the store has it"),
        ("age_days", _F, "of a logged row, when training began (`created_ns` of config.json)"),
        ("age_env_steps", _I, "of a fresh row: environment steps since it was collected"),
        ("age_gradient_steps", _I, "of a fresh row: updates since its action was chosen"),
        ("stratum", _S, "by which it was drawn"),
        ("condition", _S, "null for a fresh row whose episode had not ended with the run"),
        ("behaviour_policy", _S, "who acted"),
        ("behaviour_version", _S, "of that policy"),
        ("perturbation", _S, "of the twin; null for hardware"),
        ("perturbation_values", VALUES, "of a fresh row; of a logged one the store has them"),
        ("action", pa.int16(), "index of the discrete action"),
        ("greedy_action", pa.int16(), "what the policy of that moment would do there"),
        ("reward", _F, "the row's n-step return"),
        ("discount", _F, "of what follows it; 0: terminated"),
        ("weight", _F, "importance weight"),
        ("q", _F, "Q(s, a) before the update"),
        ("td", _F, "Q(s, a) - target before the update"),
        ("last_target_sync", _I, "gradient step after which the target had last moved"),
        ("row_hash", _S, "of the packed row, 16 hex digits: `restock trace` checks it"),
    ),
    "evaluations": _schema(
        "a fixed episode of a periodic greedy evaluation",
        *_STEPS,
        ("condition", _S, "kind of the fixed episode"),
        ("block", _S, "none | partial | full"),
        ("episode_seed", _I, "of the fixed episode"),
        ("perturbation", _S, "its name"),
        ("layout", _S, "of the floor"),
        ("perturbation_values", VALUES, "those that are not nominal"),
        ("success", _B, "at the goal without a bump; null: no goal"),
        ("bumps", _I, "times that it began to touch something"),
        ("time_s", _F, "of the episode, simulated"),
        ("return", _F, "undiscounted"),
        *_MEASURES,
        ("best", _B, "this evaluation was the best so far"),
    ),
}

# Of RUN/eval/episodes.parquet, which `restock eval` writes.
EVAL_EPISODES = _schema(
    "an episode that `restock eval` drove",
    ("policy", _S, "dqn, or what it is compared with"),
    ("perturbation", _S, "its name"),
    ("layout", _S, "of the floor"),
    ("perturbation_values", VALUES, "those that are not nominal"),
    ("condition", _S, "kind of the fixed episode"),
    ("block", _S, "none | partial | full"),
    ("episode_seed", _I, "of the fixed episode"),
    ("success", _B, "at the goal without a bump; null: no goal"),
    ("bumps", _I, "times that it began to touch something"),
    ("time_s", _F, "of the episode, simulated"),
    ("return", _F, "undiscounted"),
    *_MEASURES,
    ("time_lost_s", _F, "against the planner on the same mission; null unless both arrived"),
    ("end_x_m", _F, "where it ended"),
    ("end_y_m", _F, "where it ended"),
    ("failure", _S, "null | stuck | timeout | bump | cut"),
    ("version", _S, "of the policy; null from an earlier Restock"),
    ("layouts", _S, "floors that were asked for; null from an earlier Restock"),
    ("limited_s", _F, "that the limiter held a command back; null: it was not in front"),
    ("stopped_s", _F, "of that, to a stop"),
)

# Of RUN/eval/clones.parquet, beside it.
EVAL_CLONES = _schema(
    "a clone of the logs' drivers that an evaluation drove: how good a clone it is",
    ("policy", _S, "cloned | cloned:DRIVER"),
    ("drivers", pa.list_(_S), "behaviour policies of the rows that it is of"),
    ("rows", _I, "of the run's panel, that it learnt from"),
    ("episodes", _I, "of those rows"),
    ("updates", _I, "gradient steps, chosen by the likelihood of episodes set aside"),
    ("training_log_likelihood", _F, "mean log probability of its rows' actions, nats"),
    ("held_out_rows", _I, "of the same drivers, that the panel holds out"),
    ("log_likelihood", _F, "the same of the held-out rows' actions; null: there are none"),
    ("frequencies_log_likelihood", _F, "by how often each action was taken alone"),
    ("agreement", _F, "share of held-out rows whose action it finds likeliest"),
    ("repeating", _F, "share in which repeating the last action would agree"),
    ("changed_agreement", _F, "agreement where the driver changed the action"),
    ("note", _S, "why held-out rows could not be read, or null"),
)


def markdown() -> str:
    """The tables of docs/run.md: every column of every table."""
    parts = []
    evaluated = {"eval/episodes": EVAL_EPISODES, "eval/clones": EVAL_CLONES}
    for name, schema in {**TABLES, **evaluated}.items():
        parts.append(f"## {name}.parquet\n\nA row is {schema.metadata[b'doc'].decode()}.\n")
        parts.append("| column | type | meaning |\n| --- | --- | --- |")
        for field in schema:
            meaning = field.metadata[b"meaning"].decode().replace("|", "\\|")
            kind = "map" if field.type == VALUES else str(field.type)
            parts.append(f"| `{field.name}` | {kind} | {meaning} |".replace("<", "&lt;"))
        parts.append("")
    return "\n".join(parts)


def rewrite(text: str) -> str:
    """A page with the tables between its two markers written again."""
    before, rest = text.split(BEGIN, 1)
    return f"{before}{BEGIN}\n\n{markdown()}\n{END}{rest.split(END, 1)[1]}"


if __name__ == "__main__":
    page = Path(sys.argv[1])
    page.write_text(rewrite(page.read_text(encoding="utf-8")), encoding="utf-8")
