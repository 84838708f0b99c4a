-- The values in which drift is searched: one per episode and signal (episode_signals), and how often each condition
-- began (episode_conditions). drift.sql compares them week by week. docs/coverage.md explains the signals.

-- The names of the profiles' own signals.
CREATE OR REPLACE VIEW custom_signals AS
-- include: custom_signals.sql
;

-- The signals that are compared: the part of the robot that each describes, and the smallest change that
-- matters. `ratio`: now / before; `difference`: now - before; `spread`: the difference in standard deviations
-- between episodes of the reference.
CREATE OR REPLACE VIEW drift_signals AS
SELECT signal, part, compared, CAST(matters AS DOUBLE) AS matters, min_steps
FROM (VALUES
    ('odometry_scale', 'wheels', 'ratio', 1.02, 10),
    ('wheel_yaw_scale', 'wheels', 'ratio', 1.03, 5),
    ('wheel_pull_radpm', 'wheels', 'difference', 0.02, 10),
    ('command_gain', 'drive', 'ratio', 1.03, 5),
    ('command_response', 'drive', 'ratio', 1.2, 2),
    ('gyro_bias_radps', 'gyro', 'difference', 0.01, 10),
    ('accel_bias_mps2', 'accelerometer', 'difference', 0.1, 10),
    ('localiser_jitter_mps', 'localiser', 'ratio', 1.4, 10),
    ('localiser_age_s', 'localiser', 'difference', 0.05, 1),
    ('lidar_noise_m', 'lidar', 'ratio', 1.3, 10),
    ('silent_sectors', 'lidar', 'difference', 0.5, 10),
    ('vibration_mps2', 'floor', 'ratio', 1.4, 10),
    ('wheel_speed_mps', 'driving', 'spread', 0.8, 1),
    ('wheel_yaw_rate_radps', 'driving', 'spread', 0.8, 1),
    ('gyro_yaw_rate_radps', 'driving', 'spread', 0.8, 1),
    ('localised_speed_mps', 'driving', 'spread', 0.8, 1),
    ('localised_lateral_mps', 'driving', 'spread', 0.8, 1),
    ('accel_x_mps2', 'driving', 'spread', 0.8, 1),
    ('command_speed_mps', 'driving', 'spread', 0.8, 1),
    ('command_yaw_rate_radps', 'driving', 'spread', 0.8, 1),
    ('clearance_m', 'driving', 'spread', 0.8, 1),
    ('clearance_ahead_m', 'driving', 'spread', 0.8, 1),
    ('reward', 'driving', 'spread', 0.8, 1)
) AS known (signal, part, compared, matters, min_steps)
UNION ALL
SELECT signal, 'custom', 'spread', 0.8, 1 FROM custom_signals;

-- One value per episode and signal, with its number of steps; no row if the steps are too few. Recordings
-- without a robot's tag count as one robot, "untagged".
CREATE OR REPLACE VIEW episode_signals AS
SELECT
    coalesce(robot, 'untagged') AS robot,
    coalesce(site, 'untagged') AS site,
    recording_id,
    episode_id,
    logged_start_time AS start_time,
    part,
    signal,
    value,
    measured_signals.steps AS steps
FROM measured_signals
JOIN drift_signals USING (signal)
JOIN (SELECT recording_id, episode_id, robot, site, logged_start_time FROM episodes)
    USING (recording_id, episode_id)
WHERE measured_signals.steps >= min_steps AND (compared <> 'ratio' OR value > 0);

-- Distribution of each signal over the episodes of a robot's week.
CREATE OR REPLACE VIEW signal_weeks AS
SELECT
    robot,
    site,
    CAST(date_trunc('week', start_time) AS DATE) AS week,
    part,
    signal,
    count(DISTINCT recording_id) AS recordings,
    count(*) AS episodes,
    CAST(sum(steps) AS BIGINT) AS steps,
    quantile_cont(value, 0.05) AS p05,
    quantile_cont(value, 0.25) AS p25,
    quantile_cont(value, 0.5) AS median,
    quantile_cont(value, 0.75) AS p75,
    quantile_cont(value, 0.95) AS p95
FROM episode_signals
GROUP BY ALL
ORDER BY robot, signal, week;

-- Steps and events (runs of steps) of each condition per episode and zone, including zones and episodes where
-- it never held. Zone null is the whole map.
CREATE OR REPLACE VIEW episode_conditions AS
WITH driven AS (
    SELECT
        any_value(robot) AS robot,
        any_value(site) AS site,
        recording_id,
        episode_id,
        zone,
        make_timestamp(min(start_ns + clock_offset_ns) // 1000) AS start_time,
        sum(steps * step_h) AS driven_h
    FROM zone_steps
    JOIN (
        SELECT
            recording_id,
            robot,
            site,
            coalesce(clock_offset_ns, 0) AS clock_offset_ns,
            CAST(json_extract_string(task_json, '$.control_period_s') AS DOUBLE) / 3600 AS step_h
        FROM recordings
    ) USING (recording_id)
    GROUP BY GROUPING SETS ((recording_id, episode_id, zone), (recording_id, episode_id))
), held AS (
    SELECT
        episode_id,
        zone,
        condition,
        CAST(sum(steps) AS BIGINT) AS steps,
        CAST(sum(events) AS BIGINT) AS events
    FROM condition_steps
    GROUP BY GROUPING SETS ((episode_id, zone, condition), (episode_id, condition))
)
SELECT
    coalesce(robot, 'untagged') AS robot,
    coalesce(site, 'untagged') AS site,
    recording_id,
    driven.episode_id,
    start_time,
    kinds.condition,
    driven.zone,
    driven_h,
    coalesce(held.steps, 0) AS steps,
    coalesce(held.events, 0) AS events
FROM driven
CROSS JOIN (SELECT condition FROM conditions WHERE condition <> 'nominal') AS kinds
LEFT JOIN held
    ON held.episode_id = driven.episode_id
    AND held.zone IS NOT DISTINCT FROM driven.zone
    AND held.condition = kinds.condition;

-- How often each condition began, by robot, zone (null: the whole map) and week.
CREATE OR REPLACE VIEW condition_weeks AS
SELECT
    robot,
    site,
    CAST(date_trunc('week', start_time) AS DATE) AS week,
    condition,
    zone,
    count(DISTINCT recording_id) AS recordings,
    count(*) AS episodes,
    sum(driven_h) AS driven_h,
    CAST(sum(steps) AS BIGINT) AS steps,
    CAST(sum(events) AS BIGINT) AS events,
    sum(events) / sum(driven_h) AS events_per_h
FROM episode_conditions
GROUP BY ALL
ORDER BY robot, condition, zone NULLS FIRST, week;
