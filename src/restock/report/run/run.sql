-- What the report shows of a run, one statement a fact, named by the comment before it.
-- The run's tables are views of the same names; `panel_strata` is the panel's.

-- name: sampled
-- Over the whole run, per source and stratum: what was there, intended, drawn.
-- Shares after weights are of an interval: each counts by all that its source drew in it.
WITH drawn AS (
    SELECT *, sum(drawn_rows) OVER (PARTITION BY source, gradient_steps) AS source_rows FROM strata
), totals AS (
    SELECT source, sum(drawn_rows) AS rows FROM strata GROUP BY source
)
SELECT source,
       stratum,
       any_value(timing) AS timing,
       last(available_share ORDER BY gradient_steps) AS available_share,
       last(available_rows ORDER BY gradient_steps) AS available_rows,
       last(quota_share ORDER BY gradient_steps) AS quota_share,
       sum(drawn_rows) AS drawn_rows,
       sum(drawn_rows) / sum(sum(drawn_rows)) OVER (PARTITION BY source) AS drawn_share,
       sum(effective_share * source_rows) / nullif(any_value(totals.rows), 0) AS effective_share,
       sum(reward_mean * drawn_rows) / nullif(sum(drawn_rows), 0) AS reward_mean,
       sum(terminal_share * drawn_rows) / nullif(sum(drawn_rows), 0) AS terminal_share
FROM drawn JOIN totals USING (source)
GROUP BY source, stratum
ORDER BY source DESC, available_share DESC NULLS LAST, stratum;

-- name: conditions
-- What batches held of each condition, whatever the strata are.
WITH drawn AS (
    SELECT *, sum(drawn_rows) OVER (PARTITION BY source, gradient_steps) AS source_rows
    FROM conditions
)
SELECT source, condition, sum(drawn_rows) AS drawn_rows,
       sum(drawn_rows) / sum(sum(drawn_rows)) OVER (PARTITION BY source) AS drawn_share,
       sum(effective_share * source_rows) / sum(sum(drawn_rows)) OVER (PARTITION BY source)
           AS effective_share,
       last(td_abs_mean ORDER BY gradient_steps) AS td_abs_mean
FROM drawn
GROUP BY source, condition
ORDER BY source DESC, drawn_share DESC;

-- name: actions
-- What batches held of each action, and what the policy wanted in the last quarter of the updates.
WITH counted AS (
    SELECT source, stratum, condition, action, any_value(name) AS name,
           sum(drawn_rows) AS drawn_rows,
           sum(greedy_rows) FILTER (
               gradient_steps > 0.75 * (SELECT max(gradient_steps) FROM actions)
           ) AS wanted_rows
    FROM actions
    WHERE condition <> 'unlabelled'
    GROUP BY source, stratum, condition, action
)
SELECT source, stratum, condition, action, name, drawn_rows,
       drawn_rows / sum(drawn_rows) OVER cell AS drawn_share,
       wanted_rows / nullif(sum(wanted_rows) OVER cell, 0) AS wanted_share,
       sum(wanted_rows) OVER cell AS audited_rows
FROM counted
WINDOW cell AS (PARTITION BY source, stratum, condition)
ORDER BY source DESC, stratum, condition, action;

-- name: ages
-- Age histogram per source: days for logs, environment steps for fresh rows.
SELECT source, unit, bucket, sum(count) AS rows,
       sum(count) / sum(sum(count)) OVER (PARTITION BY source, unit) AS share
FROM ages
WHERE unit IN ('days', 'env_steps')
GROUP BY source, unit, bucket
ORDER BY source DESC, bucket;

-- name: policies
-- Whose experience was drawn.
SELECT source, behaviour_policy, sum(rows) AS rows,
       sum(rows) / sum(sum(rows)) OVER (PARTITION BY source) AS share
FROM policies
GROUP BY source, behaviour_policy
ORDER BY source DESC, rows DESC;

-- name: learning
-- Success per condition at each periodic greedy evaluation on fixed episodes.
SELECT env_steps, CASE WHEN block IN ('partial', 'full') THEN condition || ' (' || block || ')' ELSE condition END AS condition,
       avg(success::INT) AS success
FROM evaluations
GROUP BY ALL
ORDER BY env_steps, condition;

-- name: td
-- TD error by condition on the fixed probe.
SELECT gradient_steps, condition, sum(td_abs_mean * rows) / sum(rows) AS td_abs_mean
FROM probe
WHERE td_abs_mean IS NOT NULL
GROUP BY gradient_steps, condition
ORDER BY gradient_steps, condition;

-- name: lag
-- How far the target network is behind.
SELECT gradient_steps, target_q_lag
FROM progress
WHERE gradient_steps > 0
ORDER BY gradient_steps;

-- name: loss
SELECT gradient_steps, phase, loss
FROM progress
WHERE updates > 0
ORDER BY gradient_steps;

-- name: trained
-- What training took in all, with the steps in which no update was made.
SELECT max(env_steps) AS env_steps, max(gradient_steps) AS gradient_steps, max(wall_s) AS wall_s,
       coalesce(bool_or(phase <> 'offline' AND updates > 0), false) AS updated_online
FROM progress;

-- name: cells
-- `restock eval`: success per policy, perturbation and condition, blocks apart.
SELECT policy, perturbation,
       CASE WHEN block IN ('partial', 'full') THEN condition || ' (' || block || ')' ELSE condition END AS cell,
       list({'success': success, 'bumps': bumps, 'time_s': time_s, 'return': "return",
             'discounted_return': discounted_return, 'distance_m': distance_m,
             'closest_person_m': closest_person_m, 'time_lost_s': time_lost_s}) AS driven
FROM evaluated
GROUP BY ALL
ORDER BY policy, perturbation, cell;

-- name: failures
-- Where the agent's episodes ended that did not reach the goal.
SELECT condition, perturbation, coalesce(layout, 'default') AS layout, end_x_m, end_y_m, failure
FROM evaluated
WHERE policy = 'agent' AND NOT success;
