-- Every episode of a store as a sample of what driving yields: its kind, duration, and rows by cell.

-- Parameter $kinds: kinds of missions. An episode's kind is the condition it met in the most steps. That
-- is the true condition if the recording has it, else a label that held for at least $min_steps steps. An
-- episode that met none is nominal.
CREATE OR REPLACE TEMP TABLE yield_episodes AS
WITH held AS (
    SELECT episode_id, unnest(string_split(true_condition, ',')) AS kind, 1 AS least
    FROM transitions
    WHERE true_condition IS NOT NULL
    UNION ALL
    SELECT episode_id, unnest(conditions), $min_steps FROM transitions WHERE true_condition IS NULL
), met AS (
    SELECT episode_id, arg_max(kind, steps) AS kind
    FROM (
        SELECT episode_id, kind, count(*) AS steps
        FROM held
        WHERE kind <> 'nominal' AND list_contains($kinds, kind)
        GROUP BY episode_id, kind
        HAVING count(*) >= any_value(least)
    )
    GROUP BY episode_id
), measured AS (
    SELECT
        recording_id,
        episode_id,
        any_value(episode_index) AS episode_index,
        min(stamp_ns) AS first_ns,
        max(stamp_ns) AS last_ns,
        count(*) AS rows,
        bool_or(true_condition IS NOT NULL) AS simulated
    FROM transitions
    GROUP BY recording_id, episode_id
)
SELECT
    row_number() OVER (ORDER BY recording_id, episode_index) - 1 AS number,
    episode_id,
    first_ns,
    last_ns,
    rows,
    simulated,
    coalesce(kind, 'nominal') AS kind
FROM measured
LEFT JOIN met USING (episode_id);

CREATE OR REPLACE TEMP TABLE yield_cells AS
SELECT
    number,
    -- All conditions that hold, separated by commas. A cell names one of them.
    coalesce(nullif(array_to_string(conditions, ','), ''), primary_condition, '') AS condition,
    coalesce(zone, '') AS zone,
    action,
    coalesce(robot, '') AS robot,
    count(*) AS rows
FROM transitions
JOIN yield_episodes USING (episode_id)
GROUP BY ALL;
