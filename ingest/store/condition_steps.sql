-- Steps of each episode and zone at which a condition holds, and at how many of them it began. Over
-- `transitions`. Part of two statements, as zone_steps.sql is.
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
