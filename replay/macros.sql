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
    (epoch_ns(moment) - max(stamp_ns)) / 86400e9 AS age_min_days,
    (epoch_ns(moment) - quantile_disc(stamp_ns, 0.5)) / 86400e9 AS age_median_days,
    (epoch_ns(moment) - min(stamp_ns)) / 86400e9 AS age_max_days
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
