-- Figures for a diagnosis, one row per evaluation (window) and condition. run_evaluation_buffer,
-- run_conditions and run_progress are the run's tables.
WITH windows AS (
    SELECT gradient_steps AS until,
           coalesce(lag(gradient_steps) OVER (ORDER BY gradient_steps), 0) AS since
    FROM (SELECT DISTINCT gradient_steps FROM run_evaluation_buffer)
), replay AS (  -- draws by condition, logged and fresh together, since the evaluation before
    SELECT until, condition, sum(drawn_rows) AS replay_rows,
           sum(td_abs_mean * drawn_rows) / nullif(sum(drawn_rows), 0) AS replay_td
    FROM run_conditions
    JOIN windows ON gradient_steps > since AND gradient_steps <= until
    GROUP BY ALL
), clock AS (
    SELECT until, max(target_q_lag) AS lag, max(q_abs_max) AS q_abs_max
    FROM run_progress
    JOIN windows ON gradient_steps > since AND gradient_steps <= until
    WHERE updates > 0
    GROUP BY ALL
), drawn AS (
    SELECT until, sum(replay_rows) AS all_rows FROM replay GROUP BY until
)
SELECT h.gradient_steps AS gradient_steps,
       h.condition AS condition,
       h.rows AS evaluation_rows,
       h.rows_met / nullif(sum(h.rows_met) OVER (PARTITION BY h.gradient_steps), 0) AS met_share,
       h.logs_agreement AS agreement,
       h.logs_unexplained AS unexplained,
       h.explained AS explained,
       h.td_abs_mean AS evaluation_td,
       h.td_online_abs_mean AS evaluation_td_online,
       h.q_lag AS evaluation_lag,
       coalesce(replay_rows, 0) AS replay_rows,
       coalesce(replay_rows, 0) / nullif(all_rows, 0) AS replay_share,
       replay_td,
       clock.lag AS lag,
       clock.q_abs_max AS q_abs_max
FROM run_evaluation_buffer h
JOIN clock ON clock.until = h.gradient_steps
LEFT JOIN drawn ON drawn.until = h.gradient_steps
LEFT JOIN replay ON replay.until = h.gradient_steps AND replay.condition = h.condition
ORDER BY ALL
