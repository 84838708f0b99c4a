"""The Parquet tables of a run directory: their columns, types and meanings.

Every table is there from the first flush on, if only with no rows, so that a reader of a young or
killed run finds what it expects.
"""

from __future__ import annotations

import pyarrow as pa

from restock.ingest.task.perturbation_columns import VALUES

_CLOCKS = [("env_steps", pa.int64()), ("gradient_steps", pa.int64())]
_F, _I, _S, _B = pa.float64(), pa.int64(), pa.string(), pa.bool_()


def _schema(*fields: tuple[str, pa.DataType]) -> pa.Schema:
    return pa.schema([pa.field(name, kind) for name, kind in fields])


TABLES: dict[str, pa.Schema] = {
    # One row a logging interval: the two clocks, the loss, exploration, speed.
    "progress": _schema(
        *_CLOCKS,
        ("wall_s", _F),  # training time so far, without the time between a kill and a resume
        ("phase", _S),  # offline | warmup | online
        ("updates", _I),  # gradient steps in the interval
        ("loss", _F),
        ("td_abs_mean", _F),
        ("q_mean", _F),  # of the actions taken
        ("q_abs_max", _F),
        ("reward_mean", _F),  # of the rows drawn (n-step returns)
        ("epsilon", _F),
        ("target_rule", _S),
        ("target_param_distance", _F),  # |online - target| / |online|
        ("target_q_lag", _F),  # mean |Q - Q_target| / mean |Q| on the probe
        ("target_sampled", _S),  # now | before_sync (with a hard rule whose sync fell in here)
        ("last_sync", _I),  # the gradient step after which the target last moved
        ("steps_since_sync", _I),
        ("logs_share", _F),  # of the rows drawn
        ("ring_rows", _I),
        ("episodes", _I),  # finished in the interval, while exploring
        ("success", _F),  # of those
        ("return_mean", _F),  # of those, undiscounted
        ("env_steps_per_s", _F),
        ("updates_per_s", _F),
    ),
    # One row an interval x source x stratum: what the critic was fed. Shares are of the source.
    "strata": _schema(
        *_CLOCKS,
        ("phase", _S),
        ("source", _S),  # logs | fresh
        ("stratum", _S),
        ("timing", _S),  # pre | post, of a stratum of the logs
        ("quota_share", _F),  # what the mixture asks for; null where there is no quota
        ("available_rows", _I),  # in the panel, or in the ring now
        ("available_share", _F),
        ("drawn_rows", _I),
        ("drawn_share", _F),
        ("effective_share", _F),  # after importance weights
        ("unique_rows", _I),  # of those drawn
        ("replays_per_row", _F),  # drawn_rows / unique_rows
        ("total_drawn_rows", _I),  # since the run began
        ("td_abs_mean", _F),
        ("q_mean", _F),
        ("reward_mean", _F),
        ("terminal_share", _F),
    ),
    # One row an interval x source x condition, whatever the strata are: what batches held of each.
    "conditions": _schema(
        *_CLOCKS,
        ("phase", _S),
        ("source", _S),
        ("condition", _S),
        ("drawn_rows", _I),
        ("drawn_share", _F),  # of its source's rows
        ("effective_share", _F),  # after importance weights
        ("td_abs_mean", _F),
        ("q_mean", _F),
    ),
    # One row an interval x stratum of the logs: the shares in force at its end, and what rows had.
    "shares": _schema(
        *_CLOCKS,
        ("source", _S),  # logs, or the name of another store of the mixture
        ("stratum", _S),
        ("share", _F),  # of the logged rows of a batch
        ("planned_share", _F),  # as the run began
        ("logs_share", _F),  # of an online batch, all logged rows together
        ("rows", _I),  # in the panel
        ("drawn_rows", _I),  # since the run began
        ("replays_per_row", _F),  # drawn_rows / rows
        ("replays_max", _I),  # of one row; null where nothing limits it
        ("max_replays_per_row", _I),  # the limit
        ("replaced_rows", _I),  # draws that would have gone beyond it, given to other rows
        ("exhausted", _B),  # every row had all its draws: others have its share
    ),
    # One row an interval x source x unit x log2 bucket: how old the drawn rows were.
    "ages": _schema(
        *_CLOCKS,
        ("source", _S),
        ("unit", _S),  # days for logs; env_steps and gradient_steps for fresh rows
        ("bucket", pa.int32()),  # ages in [2**bucket, 2**(bucket + 1)); -1: below 1
        ("count", _I),
        ("p50", _F),
        ("p90", _F),
        ("p99", _F),
    ),
    # One row an interval x source x stratum x episode: draws, as rows of one episode are alike.
    "sampled_episodes": _schema(
        *_CLOCKS,
        ("source", _S),
        ("stratum", _S),
        ("episode", _S),  # of the logs: episode_id; fresh: the ring's key
        ("drawn_rows", _I),
        ("weight", _F),  # the sum of their importance weights
    ),
    # One row an interval x source x behaviour policy.
    "policies": _schema(*_CLOCKS, ("source", _S), ("behaviour_policy", _S), ("rows", _I)),
    # One row an interval x condition: the critic on a fixed set of rows.
    "probe": _schema(
        *_CLOCKS,
        ("source", _S),
        ("condition", _S),
        ("rows", _I),
        ("td_abs_mean", _F),
        ("q_mean", _F),
        ("q_lag", _F),  # mean |Q - Q_target| / mean |Q|
        ("probe_hash", _S),
    ),
    # One row an evaluation x condition: the critic on that evaluation's steps, which no replay has.
    "evaluation_buffer": _schema(
        *_CLOCKS,
        ("condition", _S),
        ("rows", _I),  # that the critic was measured on
        ("rows_met", _I),  # all of them: what driving meets
        ("td_abs_mean", _F),
        ("td_online_abs_mean", _F),  # as if the online network bootstrapped
        ("explained", _F),  # 1 - Var(TD) / Var(target): below 0 a constant would be nearer
        ("q_abs_mean", _F),
        ("q_lag", _F),  # mean |Q - Q_target| / mean |Q|
        ("logs_agreement", _F),  # of the logs' rows, those that these steps' conditions confirm
        ("logs_unexplained", _F),  # of the variance of their next observations
    ),
    # One row a measure x condition x estimator: off-policy evaluation of the offline policy.
    "off_policy": _schema(
        *_CLOCKS,
        ("measure", _S),  # return | success
        ("condition", _S),  # of the episode, or all
        ("estimator", _S),  # logged | fqe | pdwis | wdr
        ("value", _F),  # null where it is refused
        ("low", _F),  # 95 %, over episodes
        ("high", _F),
        ("refused", _S),  # why, or null
        ("episodes", _I),
        ("ess", _F),  # the least that weights are worth at a step, in episodes
        ("ess_steps", _I),  # for how many first steps they are worth enough
        ("steps", _I),  # of the longest episode
        ("horizon", _I),  # steps that are weighted; null: all
        ("epsilon", _F),  # of the greedy policy made soft
        ("discount", _F),
        ("estimated_share", _F),  # of rows whose behaviour probability was cloned, not logged
    ),
    # One row an evaluation x condition in which the guard saw a fall.
    "guard": _schema(
        *_CLOCKS,
        ("condition", _S),
        ("best", _F),  # success of the kept policy
        ("now", _F),
        ("action", _S),  # stop | rollback
    ),
    # One row a finished training episode (the agent explores in them).
    "episodes": _schema(
        *_CLOCKS,
        ("episode", _I),  # the ring's key
        ("env", pa.int32()),  # the environment it ran in
        ("episode_seed", _I),  # with true_condition and perturbation, what lays it out again
        ("perturbation", _S),  # its name
        ("layout", _S),
        ("perturbation_values", VALUES),  # those that are not nominal
        ("true_condition", _S),
        ("block", _S),  # none | partial | full
        ("conditions", pa.list_(_S)),  # labels that held at some step, as the robot can sense
        ("return", _F),
        ("success", _B),
        ("bumps", _I),
        ("steps", _I),
        ("time_s", _F),
    ),
    # One row a sampled row of the audited batches.
    "audit": _schema(
        ("gradient_step", _I),
        ("batch_row", pa.int32()),
        ("source", _S),
        ("transition_id", _I),  # logs
        ("panel_row", _I),  # logs
        ("ring_slot", _I),  # fresh
        ("episode", _S),
        ("episode_step", _I),  # fresh; of a logged row the store has it
        ("age_days", _F),  # logs
        ("age_env_steps", _I),  # fresh
        ("age_gradient_steps", _I),  # fresh
        ("stratum", _S),
        ("condition", _S),  # null while a fresh row's episode has not ended
        ("behaviour_policy", _S),
        ("behaviour_version", _S),
        ("perturbation", _S),  # of the twin; null for hardware
        ("perturbation_values", VALUES),  # fresh; of a logged row the store has them
        ("action", pa.int16()),
        ("reward", _F),  # the row's n-step return
        ("discount", _F),
        ("weight", _F),
        ("q", _F),
        ("td", _F),
        ("last_target_sync", _I),
        ("row_hash", _S),  # of the packed row, 16 hex digits
    ),
    # One row a fixed episode of a periodic greedy evaluation.
    "evaluations": _schema(
        *_CLOCKS,
        ("condition", _S),
        ("block", _S),
        ("episode_seed", _I),
        ("perturbation", _S),
        ("layout", _S),
        ("perturbation_values", VALUES),
        ("success", _B),
        ("bumps", _I),
        ("time_s", _F),
        ("return", _F),
        ("best", _B),  # this evaluation was the best so far
    ),
}

# Of RUN/eval/episodes.parquet, which `restock eval` writes.
EVAL_EPISODES = _schema(
    ("policy", _S),
    ("perturbation", _S),
    ("layout", _S),
    ("perturbation_values", VALUES),
    ("condition", _S),
    ("block", _S),
    ("episode_seed", _I),
    ("success", _B),
    ("bumps", _I),
    ("time_s", _F),
    ("return", _F),
    ("end_x_m", _F),
    ("end_y_m", _F),
    ("failure", _S),  # null | stuck | timeout | bump | cut
)
