-- The queries of a run's report, each named by the comment before it. They read the run's tables;
-- `evaluated` has the episodes of `restock eval`.

-- name: sampled
-- Rows available, quota and rows drawn per source and stratum, over the whole run.
-- effective_share is a share after weights in one logging interval. Intervals are averaged with
-- the rows that the source drew in each as weights.
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
       sum(terminal_share * drawn_rows) / nullif(sum(drawn_rows), 0) AS terminal_share
FROM drawn JOIN totals USING (source)
GROUP BY source, stratum
ORDER BY source DESC, available_share DESC NULLS LAST, stratum;

-- name: conditions
-- Rows of each condition in the batches, whatever the strata are.
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

-- name: ages
-- Quantiles of the ages, as the upper ends of their log2 buckets: days for logs, environment steps for fresh rows.
WITH buckets AS (
    SELECT source, unit, bucket, sum(sum(count)) OVER (PARTITION BY source, unit) AS rows,
           sum(sum(count)) OVER (PARTITION BY source, unit ORDER BY bucket) AS up_to
    FROM ages
    WHERE unit IN ('days', 'env_steps')
    GROUP BY source, unit, bucket
), ends AS (
    SELECT source, unit, rows, up_to, format('below {:,}', CAST(2 ** (bucket + 1) AS BIGINT)) AS age
    FROM buckets
)
SELECT source, unit, CAST(any_value(rows) AS BIGINT) AS rows,
       arg_min(age, up_to) FILTER (up_to >= 0.5 * rows) AS p50,
       arg_min(age, up_to) FILTER (up_to >= 0.9 * rows) AS p90,
       arg_min(age, up_to) FILTER (up_to >= 0.99 * rows) AS p99
FROM ends
GROUP BY source, unit
ORDER BY source DESC;

-- name: policies
-- Drawn rows by behaviour policy.
SELECT source, behaviour_policy, CAST(sum(rows) AS BIGINT) AS rows,
       sum(rows) / sum(sum(rows)) OVER (PARTITION BY source) AS share
FROM policies
GROUP BY source, behaviour_policy
ORDER BY source DESC, rows DESC;

-- name: practice
-- Share of each arm among the twin's missions: wanted at first and at last, and of the missions that ended.
SELECT any_value(rule) AS rule, arm, any_value(natural_share) AS natural_share,
       first(wanted_share ORDER BY env_steps) AS first_share,
       last(wanted_share ORDER BY env_steps) AS last_share,
       sum(episodes) / nullif(sum(sum(episodes)) OVER (), 0) AS given_share,
       CAST(sum(episodes) AS BIGINT) AS episodes,
       sum(episodes * success) / nullif(sum(episodes), 0) AS success
FROM (SELECT *, row_number() OVER () AS place FROM practice)
GROUP BY arm
ORDER BY min(place);

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
SELECT gradient_steps, target_q_lag, 'relative value lag' AS what
FROM progress
WHERE gradient_steps > 0 AND target_q_lag IS NOT NULL
ORDER BY gradient_steps;

-- name: loss
SELECT gradient_steps, phase, loss
FROM progress
WHERE updates > 0
ORDER BY gradient_steps;

-- name: clocks
SELECT max(env_steps) AS env_steps, max(gradient_steps) AS gradient_steps, max(wall_s) AS wall_s
FROM progress;

-- name: failures
-- Where the agent's failed episodes ended.
SELECT condition, perturbation, coalesce(layout, 'default') AS layout, end_x_m, end_y_m, failure
FROM evaluated
WHERE policy = 'agent' AND NOT success;
