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
from restock.words import between

BEGIN = "<!-- tables: written by `python -m restock.train.run.run_tables docs/run.md` -->"
END = "<!-- end of tables -->"

_F, _I, _S, _B = pa.float64(), pa.int64(), pa.string(), pa.bool_()
_STEPS = [
    ("env_steps", _I, "environment steps so far, all environments together"),
    ("gradient_steps", _I, "updates so far"),
]
_MEASURES = [
    (
        "discounted_return",
        _F,
        "discounted return from the first step, with the run's `loss.discount`",
    ),
    ("distance_m", _F, "distance driven over ground"),
    ("closest_person_m", _F, "least true distance to a person or forklift; null: there was none"),
]


def _schema(doc: str, *columns: tuple[str, pa.DataType, str]) -> pa.Schema:
    fields = [pa.field(name, kind, metadata={"meaning": text}) for name, kind, text in columns]
    return pa.schema(fields, metadata={"doc": doc})


TABLES: dict[str, pa.Schema] = {
    "progress": _schema(
        "one logging interval: the two clocks, the loss, exploration, target lag, speed",
        *_STEPS,
        ("wall_s", _F, "training time so far, without the time between a kill and a resume"),
        ("phase", _S, "offline | warmup | online"),
        ("updates", _I, "gradient steps in the interval"),
        ("loss", _F, "mean loss of an update"),
        ("td_abs_mean", _F, "mean |Q(s, a) - target| of the rows drawn"),
        ("q_mean", _F, "mean Q of the actions taken"),
        ("q_abs_max", _F, "the largest |Q| of an action taken"),
        ("reward_mean", _F, "mean reward of the rows drawn (n-step returns)"),
        ("epsilon", _F, "probability of a random action; null while offline"),
        ("target_rule", _S, "how the target network follows, in words"),
        ("target_param_distance", _F, "|online - target| / |online|, over all parameters"),
        ("target_q_lag", _F, "mean |Q - Q_target| / mean |Q| on the probe"),
        (
            "target_sampled",
            _S,
            "when the two columns above were measured: now | before_sync (hard rule)",
        ),
        ("last_sync", _I, "gradient step after which the target network was last updated"),
        ("steps_since_sync", _I, "gradient steps since then"),
        ("logs_share", _F, "share of the rows drawn that are from logs"),
        ("ring_rows", _I, "number of fresh rows in the ring"),
        ("planned_env_steps", _I, "environment steps that the shares of batches are planned for"),
        ("episodes", _I, "episodes finished in the interval, while exploring"),
        ("success", _F, "share of those that reached the goal without a bump; null: no goal"),
        ("return_mean", _F, "mean undiscounted return of those"),
        ("env_steps_per_s", _F, "environment steps per second, over the interval"),
        ("updates_per_s", _F, "updates per second, over the interval"),
    ),
    "fed": _schema(
        "one interval x stratum: the quota of a batch, and the rows that filled it",
        *_STEPS,
        ("phase", _S, "offline | warmup | online"),
        ("stratum", _S, "stratum of the mixture; unlabelled: fresh rows in none"),
        ("natural_share", _F, "share that the same sources would give if drawn from uniformly"),
        ("wanted_share", _F, "quota: the share of all rows fed that the mixture asks for"),
        ("drawn_share", _F, "share of all rows fed: logs_share + fresh_share"),
        ("logs_share", _F, "share of all rows fed that are logged rows of the stratum"),
        ("fresh_share", _F, "share of all rows fed that are fresh rows of the stratum"),
        ("short_share", _F, "wanted_share - drawn_share, if that is above 0"),
        ("reason", _S, "why it was short; null if it was not"),
        ("drawn_rows", _I, "number of rows fed"),
    ),
    "strata": _schema(
        "one interval x source x stratum: the rows drawn, by where they came from",
        *_STEPS,
        ("phase", _S, "offline | warmup | online"),
        ("source", _S, "logs | fresh"),
        ("stratum", _S, "stratum of that source"),
        (
            "timing",
            _S,
            "pre | post: whether a stratum of the logs is defined before or by the outcome",
        ),
        (
            "quota_share",
            _F,
            "share of the logged rows that the mixture asks for; null without a quota",
        ),
        ("available_rows", _I, "number of rows in the panel, or now in the ring"),
        (
            "available_share",
            _F,
            "share of the source's rows; of the logs, those in the panel, after the caps of the "
            "mixture, whose natural shares count the rows before them",
        ),
        ("drawn_rows", _I, "number of rows drawn in the interval"),
        ("drawn_share", _F, "share of the source's drawn rows"),
        ("effective_share", _F, "the same share after importance weights"),
        ("unique_rows", _I, "number of different rows among those drawn"),
        ("replays_per_row", _F, "drawn_rows / unique_rows"),
        ("total_drawn_rows", _I, "number of rows drawn since the run began"),
        ("td_abs_mean", _F, "mean |Q(s, a) - target| of the rows drawn"),
        ("q_mean", _F, "mean Q of the actions taken"),
        ("reward_mean", _F, "mean n-step return"),
        ("terminal_share", _F, "share of the rows drawn that do not bootstrap"),
    ),
    "conditions": _schema(
        "one interval x source x condition: what the batches contained",
        *_STEPS,
        ("phase", _S, "offline | warmup | online"),
        ("source", _S, "logs | fresh"),
        ("condition", _S, "condition of the rows, whatever the strata are"),
        ("drawn_rows", _I, "number of rows drawn in the interval"),
        ("drawn_share", _F, "share of the source's drawn rows"),
        ("effective_share", _F, "the same share after importance weights"),
        ("td_abs_mean", _F, "mean |Q(s, a) - target| of the rows drawn"),
        ("q_mean", _F, "mean Q of the actions taken"),
    ),
    "actions": _schema(
        "one interval x source x stratum x condition x action: what the batches contained, and "
        "what the policy wants",
        *_STEPS,
        ("phase", _S, "offline | warmup | online"),
        ("source", _S, "logs | fresh"),
        ("stratum", _S, "stratum of that source"),
        ("condition", _S, "condition of the drawn rows"),
        (
            "action",
            pa.int16(),
            "index of the discrete action, including actions that were never drawn",
        ),
        ("name", _S, "of the action"),
        ("drawn_rows", _I, "number of rows drawn in the interval"),
        ("drawn_share", _F, "share of the rows drawn of that stratum and condition"),
        ("unique_rows", _I, "number of different rows among those drawn"),
        ("audited_rows", _I, "number of rows of that stratum and condition in audited batches"),
        (
            "greedy_rows",
            _I,
            "number of those in which the policy at that time would take this action",
        ),
        ("greedy_share", _F, "greedy_rows / audited_rows; null without audited rows"),
    ),
    "shares": _schema(
        "one interval x stratum of the logs: the share in force, and how often rows were drawn",
        *_STEPS,
        ("source", _S, "logs, or the name of another store of the mixture"),
        ("stratum", _S, "stratum of the logs"),
        ("share", _F, "share of the logged rows of a batch, in force at the end of the interval"),
        ("planned_share", _F, "the same when the run began"),
        ("logs_share", _F, "share of logged rows, of all strata together, in an online batch"),
        ("rows", _I, "number of rows in the panel"),
        ("drawn_rows", _I, "number of rows drawn since the run began"),
        ("replays_per_row", _F, "drawn_rows / rows"),
        ("replays_max", _I, "largest number of draws of one row; null if there is no limit"),
        ("max_replays_per_row", _I, "the limit"),
        ("replaced_rows", _I, "number of draws beyond the limit that were given to other rows"),
        ("exhausted", _B, "all rows reached the limit of draws: other strata get this share"),
    ),
    "ages": _schema(
        "one interval x source x unit x log2 bucket: how old the drawn rows were",
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
        "one interval x source x stratum x condition x episode: how often it was drawn",
        *_STEPS,
        ("source", _S, "logs | fresh"),
        ("stratum", _S, "stratum of that source"),
        ("condition", _S, "condition of the rows, whatever the strata are"),
        ("episode", _S, "logs: episode_id; fresh: the key in the ring"),
        ("drawn_rows", _I, "number of rows drawn in the interval"),
        ("weight", _F, "sum of their importance weights"),
    ),
    "policies": _schema(
        "one interval x source x behaviour policy of the drawn rows",
        *_STEPS,
        ("source", _S, "logs | fresh"),
        ("behaviour_policy", _S, "who acted"),
        ("rows", _I, "number of rows drawn in the interval"),
    ),
    "probe": _schema(
        "one interval x condition: the critic on a fixed set of rows",
        *_STEPS,
        ("source", _S, "logs | fresh: the source of the fixed rows"),
        ("condition", _S, "condition of the fixed rows"),
        ("rows", _I, "number of fixed rows of the condition"),
        ("td_abs_mean", _F, "mean |Q(s, a) - target|"),
        ("q_mean", _F, "mean Q of the actions taken"),
        ("q_lag", _F, "mean |Q - Q_target| / mean |Q|"),
        (
            "probe_hash",
            _S,
            "hash of the fixed rows: runs can be compared and resumed only if it is the same",
        ),
    ),
    "evaluation_buffer": _schema(
        "one evaluation x condition: the critic on its steps, which are never replayed",
        *_STEPS,
        ("condition", _S, "condition of the evaluation's steps"),
        ("rows", _I, "number of steps on which the critic was measured"),
        ("rows_met", _I, "number of all such steps: how often driving meets the condition"),
        ("td_abs_mean", _F, "mean |Q(s, a) - target|"),
        ("td_online_abs_mean", _F, "the same, with the online network for the bootstrap"),
        (
            "explained",
            _F,
            "1 - Var(TD) / Var(target); below 0, a constant would be a better prediction",
        ),
        ("q_abs_mean", _F, "mean |Q| of the actions taken"),
        ("q_lag", _F, "mean |Q - Q_target| / mean |Q|"),
        (
            "logs_agreement",
            _F,
            "share of the logs' rows of the condition that look like these steps and those in the "
            "ring",
        ),
        (
            "logs_unexplained",
            _F,
            "share of the variance of their next observations that is unexplained",
        ),
    ),
    "off_policy": _schema(
        "one measure x condition x estimator: the offline policy on held-out logs",
        *_STEPS,
        ("measure", _S, "return | success"),
        ("condition", _S, "condition of the episode, or all"),
        ("estimator", _S, "logged | fqe | pdwis | wdr"),
        ("value", _F, "the estimate; null if it is refused"),
        ("low", _F, "lower end of its 95 % interval, over episodes; null for fqe"),
        ("high", _F, "upper end"),
        ("refused", _S, "why it is refused, or null"),
        ("episodes", _I, "number of episodes of the logs"),
        ("ess", _F, "smallest effective sample size of the weights at any step, in episodes"),
        ("ess_steps", _I, "number of first steps with a sufficient effective sample size"),
        ("steps", _I, "length of the longest episode"),
        ("horizon", _I, "number of steps that are weighted; null: all"),
        ("epsilon", _F, "epsilon of the evaluated policy, which is otherwise greedy"),
        ("discount", _F, "discount per step"),
        (
            "estimated_share",
            _F,
            "share of rows whose behaviour probability was estimated by cloning, not logged",
        ),
    ),
    "offline_start": _schema(
        "one candidate for the first policy x all, nominal and rare episodes of held-out logs",
        *_STEPS,
        ("candidate", _S, "as learnt | values | filtered RATIO | cloned | proposed | proposed, …"),
        ("chosen", pa.bool_(), "whether it drove until online updates began"),
        ("measure", _S, "success | return (without a goal)"),
        ("condition", _S, "nominal | rare (an episode that met a condition) | all: their mean"),
        ("value", _F, "weighted doubly robust over the first `reach` steps, then the model"),
        (
            "low",
            _F,
            "lower end of its 95 % interval, over episodes; the candidate with the largest value "
            "for `all` is chosen",
        ),
        ("high", _F, "upper end"),
        ("refused", _S, "why its lower bound is not trusted, or null"),
        ("model", _F, "estimate by fitted Q evaluation alone"),
        ("episodes", _I, "number of episodes of the logs"),
        ("ess", _F, "smallest effective sample size of the weights at any step, in episodes"),
        (
            "reach",
            _I,
            "number of first steps with a sufficient effective sample size; for `all`: "
            "the smallest",
        ),
        (
            "estimated_share",
            _F,
            "share of rows whose behaviour probability was estimated by cloning, not logged",
        ),
    ),
    "guard": _schema(
        "one evaluation x condition in which the guard saw a fall, and what was done",
        *_STEPS,
        ("condition", _S, "condition in which success fell"),
        ("best", _F, "success of the kept policy"),
        ("now", _F, "success of this evaluation"),
        ("action", _S, "stop | rollback"),
    ),
    "episodes": _schema(
        "one finished training episode (with exploration)",
        *_STEPS,
        ("episode", _I, "key of the episode in the ring"),
        ("env", pa.int32(), "index of the environment in which it ran"),
        (
            "episode_seed",
            _I,
            "seed that, with true_condition and perturbation, generates the episode again",
        ),
        ("perturbation", _S, "its name"),
        ("layout", _S, "name of the floor"),
        ("perturbation_values", VALUES, "parameters that are not nominal"),
        ("true_condition", _S, "kind of episode that the twin drew"),
        ("block", _S, "none | partial | full"),
        (
            "conditions",
            pa.list_(_S),
            "labels that held at some step, computed from what the robot can sense",
        ),
        ("return", _F, "undiscounted"),
        ("success", _B, "reached the goal without a bump; null: no goal"),
        ("bumps", _I, "number of times that a contact began"),
        ("steps", _I, "number of steps of the episode"),
        ("time_s", _F, "simulated time of the episode"),
    ),
    "practice": _schema(
        "one interval of practice x arm: the missions that the twin should give, and gave",
        *_STEPS,
        ("rule", _S, "natural | even | shares | logs | missions | success | regret"),
        ("arm", _S, "kind of missions, with its block, floor or part of a range"),
        ("condition", _S, "kind of episode of the arm"),
        ("natural_share", _F, "share of the missions by `env`"),
        ("wanted_share", _F, "share in force in the interval"),
        ("given_share", _F, "share of the episodes that ended in it; null if there were none"),
        ("episodes", _I, "number of episodes that ended in it, while exploring"),
        ("success", _F, "success of those; null if there were none"),
        (
            "success_rate",
            _F,
            "success over episodes, with decreasing weights of older ones; null: too few",
        ),
        ("reference", _F, "success of the reference driver for the regret; null with other rules"),
        (
            "weight",
            _F,
            "score by which the rule sets shares, before floors and the limit of change",
        ),
        ("total_episodes", _I, "episodes of the arm since the run began"),
    ),
    "teacher": _schema(
        "one interval x source x condition: what the teacher's filter did in a sample of states",
        *_STEPS,
        ("source", _S, "logs: cloned rows | fresh: rows of the ring"),
        ("condition", _S, "condition of those rows"),
        (
            "ratio",
            _F,
            "ratio in force: an action is plausible if its probability is at least this "
            "share of the most probable action's",
        ),
        ("rows", _I, "number of rows in the random sample"),
        ("asked_rows", _I, "number of those for which the teacher gave an action"),
        ("loss", _F, "mean -log G(a|s) of its action; null if it gave none"),
        (
            "agreement",
            _F,
            "share in which its action is the most probable one of the behaviour network",
        ),
        ("plausible_actions", _F, "mean number of plausible actions"),
        ("teacher_plausible", _F, "share in which its action is plausible"),
        ("changed", _F, "share in which the filter changed the action chosen by Q"),
        ("chosen_agreement", _F, "share in which the filtered choice is its action"),
    ),
    "audit": _schema(
        "one drawn row of a seeded sample of batches",
        ("gradient_step", _I, "gradient step of its batch"),
        ("batch_row", pa.int32(), "its position in the batch"),
        ("source", _S, "logs | fresh"),
        (
            "transition_id",
            _I,
            "of a logged row: id of the transition, joins the store's transitions",
        ),
        ("panel_row", _I, "of a logged row: its row number in the panel"),
        ("ring_slot", _I, "of a fresh row: its slot in the ring"),
        ("episode", _S, "logs: episode_id; fresh: the key in the ring"),
        ("episode_step", _I, "of a fresh row; of a logged one the store has it"),
        ("age_days", _F, "of a logged row, when training began (`created_ns` of config.json)"),
        ("age_env_steps", _I, "of a fresh row: environment steps since it was collected"),
        (
            "age_gradient_steps",
            _I,
            "of a fresh row: updates since its action was chosen; of a logged row, which could be "
            "drawn from the start: updates since the run began, `gradient_step`",
        ),
        ("stratum", _S, "stratum by which it was drawn"),
        (
            "condition",
            _S,
            "condition; null for a fresh row whose episode had not ended when the run ended",
        ),
        ("behaviour_policy", _S, "who acted"),
        ("behaviour_version", _S, "version of that policy"),
        ("perturbation", _S, "of the twin; null for hardware"),
        ("perturbation_values", VALUES, "of a fresh row; of a logged one the store has them"),
        ("action", pa.int16(), "index of the discrete action"),
        ("greedy_action", pa.int16(), "action that the policy at that time would take"),
        ("reward", _F, "the row's n-step return"),
        ("discount", _F, "discount of the bootstrap; 0: terminated"),
        ("weight", _F, "importance weight"),
        ("q", _F, "Q(s, a) before the update"),
        ("td", _F, "Q(s, a) - target before the update"),
        (
            "last_target_sync",
            _I,
            "gradient step after which the target network was last updated; null: in a run of "
            "another library",
        ),
        ("row_hash", _S, "checksum of the packed row, 16 hex digits; checked by `restock trace`"),
    ),
    "evaluations": _schema(
        "one fixed episode of a periodic greedy evaluation",
        *_STEPS,
        ("condition", _S, "kind of the fixed episode"),
        ("block", _S, "none | partial | full"),
        ("episode_seed", _I, "seed of the fixed episode"),
        ("perturbation", _S, "its name"),
        ("layout", _S, "name of the floor"),
        ("perturbation_values", VALUES, "parameters that are not nominal"),
        ("success", _B, "reached the goal without a bump; null: no goal"),
        ("bumps", _I, "number of times that a contact began"),
        ("time_s", _F, "simulated time of the episode"),
        ("return", _F, "undiscounted"),
        *_MEASURES,
        ("best", _B, "whether this evaluation was the best so far"),
    ),
}

# Of RUN/eval/episodes.parquet, which `restock eval` writes.
EVAL_EPISODES = _schema(
    "one episode that `restock eval` drove",
    ("policy", _S, "dqn, or a policy with which it is compared"),
    ("perturbation", _S, "its name"),
    ("layout", _S, "name of the floor"),
    ("perturbation_values", VALUES, "parameters that are not nominal"),
    ("condition", _S, "kind of the fixed episode"),
    ("block", _S, "none | partial | full"),
    ("episode_seed", _I, "seed of the fixed episode"),
    ("success", _B, "reached the goal without a bump; null: no goal"),
    ("bumps", _I, "number of times that a contact began"),
    ("time_s", _F, "simulated time of the episode"),
    ("return", _F, "undiscounted"),
    *_MEASURES,
    (
        "time_lost_s",
        _F,
        "time lost against the planner on the same mission; null unless both arrived",
    ),
    ("end_x_m", _F, "x of the position where it ended"),
    ("end_y_m", _F, "y of the position where it ended"),
    ("failure", _S, "null | stuck | timeout | bump | cut"),
    ("version", _S, "version of the policy; null: from an earlier Restock"),
    (
        "trained_env_steps",
        _I,
        "environment steps of its training; null: scripted, cloned, or a file's",
    ),
    ("layouts", _S, "floors that were requested; null: from an earlier Restock"),
    (
        "limited_s",
        _F,
        "time in which the limiter reduced a command; null: there was no limiter",
    ),
    ("stopped_s", _F, "time in which it reduced the command to a stop"),
)

# Of RUN/eval/clones.parquet, beside it.
EVAL_CLONES = _schema(
    "one clone of the logs' drivers that an evaluation drove, and its quality",
    ("policy", _S, "cloned | cloned:DRIVER"),
    ("drivers", pa.list_(_S), "behaviour policies of the rows from which it was cloned"),
    ("rows", _I, "number of rows of the run's panel from which it was cloned"),
    ("episodes", _I, "number of episodes of those rows"),
    ("updates", _I, "gradient steps, chosen by the likelihood of validation episodes"),
    ("training_log_likelihood", _F, "mean log probability of its rows' actions, nats"),
    ("held_out_rows", _I, "number of rows of the same drivers that the panel holds out"),
    ("log_likelihood", _F, "the same for the held-out rows; null: there are none"),
    ("frequencies_log_likelihood", _F, "the same, with only the frequency of each action"),
    ("agreement", _F, "share of held-out rows whose action is its most probable one"),
    ("repeating", _F, "share in which the action equals the previous one"),
    ("changed_agreement", _F, "agreement in the rows in which the driver changed the action"),
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
    return between(text, BEGIN, END, markdown())


if __name__ == "__main__":
    page = Path(sys.argv[1])
    page.write_text(rewrite(page.read_text(encoding="utf-8")), encoding="utf-8")
