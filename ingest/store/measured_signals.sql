-- The values in which drift is searched: one per episode and signal, with the number of steps that it is
-- computed from. A signal has no row if the robot lacks its sensor. Values that describe the robot leave
-- out slipping steps. From `transitions` and `recordings`. Included in two statements: the view that scans
-- rows, and the summary in a manifest. A profile's own signals are in measured_custom_signals.sql.
WITH tasks AS (
    SELECT
        task_hash,
        len(commands) AS actions,
        list_max(list_transform(commands, lambda command: abs(command[1]))) AS top_mps,
        list_max(list_transform(commands, lambda command: abs(command[2]))) AS top_radps,
        sectors,
        period_s,
        range_max_m
    FROM (
        SELECT DISTINCT
            task_hash,
            from_json(json_extract_string(task_json, '$.actions'), '[["DOUBLE"]]') AS commands,
            CAST(json_extract_string(task_json, '$.sectors') AS INTEGER) AS sectors,
            CAST(json_extract_string(task_json, '$.control_period_s') AS DOUBLE) AS period_s,
            CAST(json_extract_string(task_json, '$.range_max_m') AS DOUBLE) AS range_max_m
        FROM recordings
    )
), cleared AS (
    -- Window functions keep all this in memory: only needed columns, and sectors as observed, which halves their bytes.
    SELECT
        recording_id,
        episode_id,
        step_index,
        stamp_ns,
        pose_stamp_ns,
        pose_yaw_rad,
        wheel_speed_mps,
        wheel_yaw_rate_radps,
        gyro_yaw_rate_radps,
        accel_x_mps2,
        localised_speed_mps,
        localised_lateral_mps,
        command_speed_mps,
        command_yaw_rate_radps,
        clearance_m,
        clearance_ahead_m,
        reward,
        NOT list_contains(conditions, 'wheel_slip') AS grips,
        top_mps,
        top_radps,
        period_s,
        range_max_m,
        observation[13 + actions:12 + actions + sectors] AS nearness
    FROM transitions
    JOIN tasks USING (task_hash)
), steps AS (
    SELECT
        *,
        lag(nearness) OVER episode AS nearness_before,
        lag(nearness, 2) OVER episode AS nearness_long_before,
        (stamp_ns - lag(stamp_ns) OVER episode) / 1e9 AS elapsed_s,
        (wheel_speed_mps + lag(wheel_speed_mps) OVER episode) / 2 AS mean_wheel_mps,
        (wheel_yaw_rate_radps + lag(wheel_yaw_rate_radps) OVER episode) / 2 AS mean_wheel_radps,
        (gyro_yaw_rate_radps + lag(gyro_yaw_rate_radps) OVER episode) / 2 AS mean_gyro_radps,
        wheel_speed_mps - lag(wheel_speed_mps) OVER episode AS wheel_change_mps,
        (pose_yaw_rad - lag(pose_yaw_rad) OVER episode + 3 * pi()) % (2 * pi()) - pi() AS turned_rad,
        lag(command_speed_mps) OVER episode AS command_mps, -- in force until this step
        lag(command_speed_mps, 2) OVER episode AS command_before_mps,
        lag(command_speed_mps, 3) OVER episode AS command_long_before_mps,
        -- Ingest copies the wheels' value to these columns if there is no new pose, or no gyroscope.
        localised_speed_mps <> wheel_speed_mps AS has_pose,
        gyro_yaw_rate_radps <> wheel_yaw_rate_radps AS has_gyro
    FROM cleared
    WINDOW episode AS (PARTITION BY episode_id ORDER BY step_index)
), kinds AS (
    SELECT
        *,
        grips AND elapsed_s < 1.5 * period_s
        AND greatest(abs(mean_wheel_radps), abs(wheel_yaw_rate_radps)) < 0.1 * top_radps AS straight,
        least(abs(mean_wheel_mps), abs(wheel_speed_mps)) > 0.3 * top_mps AS moving,
        grips AND has_gyro AND abs(wheel_yaw_rate_radps) > 0.3 * top_radps AS turning,
        grips AND command_mps > 0.3 * top_mps
        AND command_mps = command_before_mps AND command_mps = command_long_before_mps AS held,
        grips AND abs(command_mps - command_before_mps) > 0.3 * top_mps
        AND command_before_mps = command_long_before_mps AS stepped
    FROM steps
), flagged AS (
    SELECT
        *,
        straight AND moving AND has_pose AS tracked,
        straight AND has_gyro AS gyro_straight,
        straight AND moving AND abs(wheel_change_mps) < 0.05 * top_mps AND accel_x_mps2 <> 0 AS steady,
        -- The range to a straight wall changes evenly: the second difference is noise.
        CASE WHEN straight THEN list_median(list_transform(
            list_transform(
                list_zip(nearness, nearness_before, nearness_long_before),
                lambda n: [n[1] * n[1] * range_max_m, n[2] * n[2] * range_max_m, n[3] * n[3] * range_max_m]
            ),
            lambda m: CASE WHEN greatest(m[1], m[2], m[3]) < range_max_m
                THEN abs(m[1] - 2 * m[2] + m[3]) END
        )) END AS unevenness_m
    FROM kinds
), silent AS ( -- sectors without change: dead, covered, or facing open space, which look the same
    SELECT episode_id, count(*) FILTER (spread_m < 0.005) AS silent_sectors
    FROM (
        SELECT episode_id, sector, max(m) - min(m) AS spread_m
        FROM (
            SELECT
                episode_id,
                unnest(list_transform(nearness, lambda n: n * n * range_max_m)) AS m,
                generate_subscripts(nearness, 1) AS sector
            FROM cleared
        )
        GROUP BY episode_id, sector
    )
    GROUP BY episode_id
), summed AS (
    SELECT
        recording_id,
        episode_id,
        unnest([
            {
                signal: 'odometry_scale',
                value: sum(localised_speed_mps) FILTER (tracked) / sum(mean_wheel_mps) FILTER (tracked),
                steps: count(*) FILTER (tracked)
            },
            {
                signal: 'wheel_yaw_scale',
                value: median(gyro_yaw_rate_radps / wheel_yaw_rate_radps) FILTER (turning),
                steps: count(*) FILTER (turning)
            },
            {
                signal: 'wheel_pull_radpm',
                value: sum(turned_rad - mean_wheel_radps * elapsed_s) FILTER (tracked)
                    / sum(abs(mean_wheel_mps) * elapsed_s) FILTER (tracked),
                steps: count(*) FILTER (tracked)
            },
            {
                signal: 'command_gain',
                value: sum(wheel_speed_mps) FILTER (held) / sum(command_mps) FILTER (held),
                steps: count(*) FILTER (held)
            },
            {
                signal: 'command_response',
                value: sum(wheel_change_mps * sign(command_mps - command_before_mps)) FILTER (stepped)
                    / sum(abs(command_mps - command_before_mps)) FILTER (stepped),
                steps: count(*) FILTER (stepped)
            },
            {
                signal: 'gyro_bias_radps',
                value: sum(mean_gyro_radps * elapsed_s - turned_rad) FILTER (gyro_straight)
                    / sum(elapsed_s) FILTER (gyro_straight),
                steps: count(*) FILTER (gyro_straight)
            },
            {
                signal: 'accel_bias_mps2',
                value: median(accel_x_mps2) FILTER (steady),
                steps: count(*) FILTER (steady)
            },
            {
                signal: 'vibration_mps2', -- normal noise: the median deviation is .6745 standard deviations
                value: mad(accel_x_mps2) FILTER (steady) / 0.6745,
                steps: count(*) FILTER (steady)
            },
            {
                signal: 'localiser_jitter_mps',
                value: median(abs(localised_lateral_mps)) FILTER (tracked),
                steps: count(*) FILTER (tracked)
            },
            {
                signal: 'localiser_age_s',
                value: avg((stamp_ns - pose_stamp_ns) / 1e9),
                steps: count(pose_stamp_ns)
            },
            {
                signal: 'lidar_noise_m',
                value: median(unevenness_m) / 0.6745 / sqrt(6),
                steps: count(unevenness_m)
            },
            {signal: 'silent_sectors', value: any_value(silent_sectors)::DOUBLE, steps: count(*)},
            {signal: 'wheel_speed_mps', value: avg(wheel_speed_mps), steps: count(wheel_speed_mps)},
            {
                signal: 'wheel_yaw_rate_radps',
                value: avg(wheel_yaw_rate_radps),
                steps: count(wheel_yaw_rate_radps)
            },
            {
                signal: 'gyro_yaw_rate_radps',
                value: avg(gyro_yaw_rate_radps),
                steps: count(*) FILTER (has_gyro)
            },
            {signal: 'localised_speed_mps', value: avg(localised_speed_mps), steps: count(*) FILTER (has_pose)},
            {
                signal: 'localised_lateral_mps',
                value: avg(localised_lateral_mps),
                steps: count(*) FILTER (has_pose)
            },
            {signal: 'accel_x_mps2', value: avg(accel_x_mps2), steps: count(nullif(accel_x_mps2, 0))},
            {signal: 'command_speed_mps', value: avg(command_speed_mps), steps: count(command_speed_mps)},
            {
                signal: 'command_yaw_rate_radps',
                value: avg(command_yaw_rate_radps),
                steps: count(command_yaw_rate_radps)
            },
            {signal: 'clearance_m', value: avg(clearance_m), steps: count(clearance_m)},
            {signal: 'clearance_ahead_m', value: avg(clearance_ahead_m), steps: count(clearance_ahead_m)},
            {signal: 'reward', value: avg(reward), steps: count(reward)}
        ], recursive := true)
    FROM flagged
    LEFT JOIN silent USING (episode_id)
    GROUP BY recording_id, episode_id
)
SELECT recording_id, episode_id, signal, value, steps
FROM summed
WHERE isfinite(value) AND steps > 0
