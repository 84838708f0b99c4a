-- Steps per episode, zone and condition at which the condition holds, and at how many of them it began.
-- From `transitions`. Included in the same two statements as zone_steps.sql.
SELECT
    recording_id,
    episode_id,
    zone,
    condition,
    count(*) AS steps,
    count(*) FILTER (NOT list_contains(coalesce(conditions_before, []), condition)) AS events
FROM (
    SELECT *, unnest(conditions) AS condition
    FROM (
        SELECT
            recording_id,
            episode_id,
            zone,
            conditions,
            lag(conditions) OVER (PARTITION BY episode_id ORDER BY step_index) AS conditions_before
        FROM transitions
    )
)
GROUP BY recording_id, episode_id, zone, condition
