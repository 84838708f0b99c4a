-- Table macros, for example: FROM cells_below(100);

-- Condition x action cells with fewer than `minimum` rows, including empty cells.
CREATE OR REPLACE MACRO cells_below(minimum) AS TABLE
SELECT condition, action, action_name, speed_mps, yaw_rate_radps, coalesce(rows, 0) AS rows
FROM (SELECT condition FROM conditions UNION SELECT condition FROM held_conditions)
CROSS JOIN (SELECT DISTINCT action, name AS action_name, speed_mps, yaw_rate_radps FROM actions)
LEFT JOIN (SELECT condition, action, count(*) AS rows FROM held_conditions GROUP BY ALL)
    USING (condition, action)
ANTI JOIN untold_conditions USING (condition)
WHERE coalesce(rows, 0) < minimum
ORDER BY condition, action;

-- Age of each condition's rows at a moment, in days.
CREATE OR REPLACE MACRO ages_at(moment) AS TABLE
SELECT
    condition,
    count(*) AS rows_held,
    (epoch_ns(moment) - max(logged_ns)) / 86400e9 AS age_min_days,
    (epoch_ns(moment) - quantile_disc(logged_ns, 0.5)) / 86400e9 AS age_median_days,
    (epoch_ns(moment) - min(logged_ns)) / 86400e9 AS age_max_days
FROM held_conditions
GROUP BY condition
ORDER BY rows_held DESC, condition;

-- Groups of rows with the same action and, after rounding, the same observation.
CREATE OR REPLACE MACRO near_duplicates(decimals) AS TABLE
SELECT
    min(transition_id) AS transition_id,
    any_value(primary_condition) AS primary_condition,
    any_value(action) AS action,
    count(*) AS copies
FROM transitions
GROUP BY hash(list_transform(observation::FLOAT[], lambda x: round(x, decimals))), action
HAVING count(*) > 1
ORDER BY copies DESC, transition_id;

-- The steps of one episode, in order.
CREATE OR REPLACE MACRO episode(id) AS TABLE
SELECT * EXCLUDE (observation, next_observation)
FROM transitions
WHERE episode_id = id
ORDER BY step_index;

-- The kind of each episode: the condition that held longest (if equally long, the first by name) among those
-- that held for at least `min_steps` steps, else nominal. True conditions are used in rows that have them.
CREATE OR REPLACE MACRO episode_kinds(min_steps) AS TABLE
WITH held AS (
    SELECT episode_id, unnest(string_split(true_condition, ',')) AS kind
    FROM transitions
    WHERE true_condition IS NOT NULL AND true_condition <> 'nominal'
    UNION ALL
    SELECT episode_id, unnest(conditions) FROM transitions WHERE true_condition IS NULL
), longest AS (
    SELECT episode_id, first(kind ORDER BY steps DESC, kind) AS kind
    FROM (SELECT episode_id, kind, count(*) AS steps FROM held GROUP BY ALL HAVING count(*) >= min_steps)
    GROUP BY episode_id
)
SELECT episode_id, coalesce(kind, 'nominal') AS kind, success, return, first_policy
FROM episodes
LEFT JOIN longest USING (episode_id);
