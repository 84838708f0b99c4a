-- severity: warning
-- advice: Look at this signal in this recording: another robot, another floor, or a sensor that changed.
-- doc: Recordings in which a signal is distributed differently than in the others (population stability index).
WITH long AS (
    UNPIVOT (
        SELECT
            recording_id,
            wheel_speed_mps::DOUBLE AS wheel_speed_mps,
            wheel_yaw_rate_radps::DOUBLE AS wheel_yaw_rate_radps,
            gyro_yaw_rate_radps::DOUBLE AS gyro_yaw_rate_radps,
            localised_speed_mps::DOUBLE AS localised_speed_mps,
            localised_lateral_mps::DOUBLE AS localised_lateral_mps,
            clearance_m::DOUBLE AS clearance_m,
            clearance_ahead_m::DOUBLE AS clearance_ahead_m,
            accel_x_mps2::DOUBLE AS accel_x_mps2
        FROM transitions
    ) ON COLUMNS(* EXCLUDE recording_id) INTO NAME signal VALUE value
), edges AS (
    SELECT signal, list_distinct(quantile_disc(value, [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9])) AS edges
    FROM long
    GROUP BY signal
), counts AS (
    SELECT recording_id, signal, len(list_filter(edges, lambda edge: value > edge)) AS bucket, count(*) AS n
    FROM long
    JOIN edges USING (signal)
    GROUP BY ALL
), grid AS (
    SELECT recording_id, signal, bucket, coalesce(n, 0) AS n
    FROM (SELECT DISTINCT recording_id FROM counts)
    CROSS JOIN (SELECT DISTINCT signal, bucket FROM counts)
    LEFT JOIN counts USING (recording_id, signal, bucket)
), shares AS (
    SELECT
        recording_id,
        signal,
        sum(n) OVER recording AS rows,
        (n + 0.5) / (sum(n) OVER recording + 0.5 * count(*) OVER recording) AS here,
        (sum(n) OVER everywhere - n + 0.5)
        / (sum(n) OVER signal - sum(n) OVER recording + 0.5 * count(*) OVER recording) AS elsewhere
    FROM grid
    WINDOW
        recording AS (PARTITION BY recording_id, signal),
        everywhere AS (PARTITION BY signal, bucket),
        signal AS (PARTITION BY signal)
)
SELECT recording_id, signal, any_value(rows) AS rows, sum((here - elsewhere) * ln(here / elsewhere)) AS psi
FROM shares
WHERE (SELECT count(*) FROM recordings) > 1
GROUP BY recording_id, signal
HAVING sum((here - elsewhere) * ln(here / elsewhere)) > $max_psi
ORDER BY psi DESC
