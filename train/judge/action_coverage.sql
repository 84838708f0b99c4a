-- Per condition and action, over the intervals after gradient step $since: how often logged batches had
-- the action, and how often the policy of that moment would take it. Fresh rows are the states that the
-- policy meets: what it wants is counted on them, and on logged rows only where there are none.
WITH recent AS (
    FROM run_actions WHERE gradient_steps > $since
), different AS (  -- in an interval: rows are drawn again in the next
    SELECT condition, action, max(unique_rows) AS unique_rows
    FROM (
        SELECT gradient_steps, condition, action, sum(unique_rows) AS unique_rows
        FROM recent
        WHERE source = 'logs'
        GROUP BY gradient_steps, condition, action
    )
    GROUP BY condition, action
), counted AS (
    SELECT
        condition, action, any_value(name) AS name,
        coalesce(sum(drawn_rows) FILTER (source = 'logs'), 0) AS logged,
        coalesce(sum(drawn_rows) FILTER (source = 'fresh'), 0) AS fresh,
        coalesce(sum(greedy_rows) FILTER (source = 'logs'), 0) AS greedy_logged,
        coalesce(sum(greedy_rows) FILTER (source = 'fresh'), 0) AS greedy_fresh
    FROM recent
    GROUP BY condition, action
), summed AS (
    SELECT
        *,
        sum(logged) OVER of_condition AS all_logged,
        sum(fresh) OVER of_condition AS all_fresh,
        sum(greedy_logged) OVER of_condition AS all_greedy_logged,
        sum(greedy_fresh) OVER of_condition AS all_greedy_fresh,
        sum(unique_rows) OVER of_condition AS different_rows
    FROM counted
    JOIN different USING (condition, action)
    WINDOW of_condition AS (PARTITION BY condition)
)
SELECT
    condition,
    name AS action,
    (CASE WHEN all_greedy_fresh > 0 THEN greedy_fresh ELSE greedy_logged END)::BIGINT AS wanted,
    (CASE WHEN all_greedy_fresh > 0 THEN all_greedy_fresh ELSE all_greedy_logged END)::BIGINT
        AS audited,
    logged / all_logged AS logs_share,
    unique_rows::BIGINT AS logged_rows,
    different_rows::BIGINT AS condition_rows,
    fresh / nullif(all_fresh, 0) AS fresh_share
FROM summed
WHERE all_logged > 0
ORDER BY condition, summed.action;
