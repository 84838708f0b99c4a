-- Table macros: questions with parameters. FROM cells_below(100);

-- Condition x action cells with fewer than `minimum` rows, empty ones included.
CREATE OR REPLACE MACRO cells_below(minimum) AS TABLE
SELECT condition, action, speed_mps, yaw_rate_radps, coalesce(rows, 0) AS rows
FROM (SELECT DISTINCT condition FROM (SELECT condition FROM conditions UNION SELECT condition FROM transitions))
CROSS JOIN (SELECT DISTINCT action, speed_mps, yaw_rate_radps FROM actions)
LEFT JOIN (SELECT condition, action, count(*) AS rows FROM transitions GROUP BY ALL)
    USING (condition, action)
WHERE coalesce(rows, 0) < minimum
ORDER BY condition, action;

-- Age of the rows of each condition at a moment, in days.
CREATE OR REPLACE MACRO ages_at(moment) AS TABLE
SELECT
    condition,
    count(*) AS rows,
    (epoch_ns(moment) - max(logged_ns)) / 86400e9 AS age_min_days,
    (epoch_ns(moment) - quantile_disc(logged_ns, 0.5)) / 86400e9 AS age_median_days,
    (epoch_ns(moment) - min(logged_ns)) / 86400e9 AS age_max_days
FROM transitions
GROUP BY condition
ORDER BY rows DESC, condition;

-- Rows whose observation and action are the same as another's after rounding.
CREATE OR REPLACE MACRO near_duplicates(decimals) AS TABLE
SELECT
    min(transition_id) AS transition_id,
    any_value(condition) AS condition,
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

-- Each episode with the one condition that best says what it was about: of those that held for at
-- least `min_steps` steps, the one that held longest; else nominal. The true condition, where known.
CREATE OR REPLACE MACRO episode_kinds(min_steps) AS TABLE
WITH held AS (
    SELECT episode_id, unnest(string_split(true_condition, ',')) AS kind
    FROM transitions
    WHERE true_condition IS NOT NULL AND true_condition <> 'nominal'
    UNION ALL
    SELECT episode_id, unnest(conditions) FROM transitions WHERE true_condition IS NULL
), longest AS (
    SELECT episode_id, arg_max(kind, steps) AS kind
    FROM (SELECT episode_id, kind, count(*) AS steps FROM held GROUP BY ALL HAVING count(*) >= min_steps)
    GROUP BY episode_id
)
SELECT episode_id, coalesce(kind, 'nominal') AS kind, success, return, first_policy
FROM episodes
LEFT JOIN longest USING (episode_id);

-- What a buffer of fewer rows would still cover, the newest rows kept: half of the rows, a quarter, …
CREATE OR REPLACE MACRO capacity_curve() AS TABLE
WITH ranked AS (
    SELECT
        condition,
        zone,
        action,
        episode_id,
        row_number() OVER (ORDER BY logged_ns DESC, transition_id DESC) AS place
    FROM transitions
), capacities AS (
    SELECT DISTINCT ceil(rows / 2.0 ^ halvings)::BIGINT AS capacity
    FROM (SELECT count(*) AS rows FROM transitions), range(0, 16) AS steps (halvings)
    WHERE ceil(rows / 2.0 ^ halvings) >= 2
), cells AS (
    SELECT condition, zone, action, min(place) AS first_place FROM ranked GROUP BY ALL
), covered AS (
    SELECT
        capacity,
        count(*) FILTER (first_place <= capacity) AS cells,
        count(*) FILTER (first_place <= capacity) / count(*) AS cells_share,
        count(DISTINCT condition) FILTER (first_place <= capacity) AS conditions
    FROM cells
    CROSS JOIN capacities
    GROUP BY capacity
), kept AS (
    SELECT capacity, count(*) AS episodes, sum(n) ^ 2 / sum(n ^ 2) AS effective_episodes
    FROM (
        SELECT capacity, episode_id, count(*) AS n
        FROM ranked
        JOIN capacities ON place <= capacity
        GROUP BY ALL
    )
    GROUP BY capacity
)
SELECT capacity, cells, cells_share, conditions, episodes, effective_episodes
FROM covered
JOIN kept USING (capacity)
ORDER BY capacity;
