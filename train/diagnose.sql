-- What a diagnosis looks at: one row an evaluation (a window) and condition. $held_out, $strata and
-- $progress are the run's Parquet files.
WITH windows AS (
    SELECT gradient_steps AS until,
           coalesce(lag(gradient_steps) OVER (ORDER BY gradient_steps), 0) AS since
    FROM (SELECT DISTINCT gradient_steps FROM read_parquet($held_out))
), replay AS (  -- of the same condition, logged and fresh together, in the window before
    SELECT until, stratum AS condition, sum(drawn_rows) AS replay_rows,
           sum(td_abs_mean * drawn_rows) / nullif(sum(drawn_rows), 0) AS replay_td,
           sum(quota_share * source_rows) FILTER (quota_share IS NOT NULL) AS asked_rows,
           sum(drawn_rows) FILTER (quota_share IS NOT NULL) AS quota_rows
    FROM (
        SELECT *, sum(drawn_rows) OVER (PARTITION BY source, gradient_steps) AS source_rows
        FROM read_parquet($strata)
    )
    JOIN windows ON gradient_steps > since AND gradient_steps <= until
    GROUP BY ALL
), clock AS (
    SELECT until, max(target_q_lag) AS lag, max(q_abs_max) AS q_abs_max
    FROM read_parquet($progress)
    JOIN windows ON gradient_steps > since AND gradient_steps <= until
    WHERE updates > 0
    GROUP BY ALL
), drawn AS (
    SELECT until, sum(replay_rows) AS all_rows FROM replay GROUP BY until
)
SELECT h.gradient_steps AS gradient_steps,
       h.condition AS condition,
       h.rows AS held_out_rows,
       h.td_abs_mean AS held_out_td,
       h.td_online_abs_mean AS held_out_td_online,
       h.q_lag AS held_out_lag,
       coalesce(replay_rows, 0) AS replay_rows,
       coalesce(replay_rows, 0) / nullif(all_rows, 0) AS replay_share,
       replay_td,
       quota_rows / nullif(asked_rows, 0) AS quota_met,
       clock.lag AS lag,
       clock.q_abs_max AS q_abs_max
FROM read_parquet($held_out) h
JOIN clock ON clock.until = h.gradient_steps
LEFT JOIN drawn ON drawn.until = h.gradient_steps
LEFT JOIN replay ON replay.until = h.gradient_steps AND replay.condition = h.condition
ORDER BY ALL
