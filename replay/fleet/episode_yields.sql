-- Every episode of a store as something that was logged once and could be logged again: what it met,
-- how long it took, and where. It takes parameters.

-- $kinds are the kinds of missions there are; an episode is of the one it met longest, by the truth
-- where the recording knew it, else by a label that held for $min_steps steps; else nominal.
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
    -- All that hold, of which a cell names one.
    coalesce(nullif(array_to_string(conditions, ','), ''), primary_condition, '') AS condition,
    coalesce(zone, '') AS zone,
    action,
    coalesce(robot, '') AS robot,
    count(*) AS rows
FROM transitions
JOIN yield_episodes USING (episode_id)
GROUP BY ALL;
