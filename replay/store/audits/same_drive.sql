-- severity: warning
-- advice: One drive was likely recorded twice (replayed, or by another profile): take one of the two recordings out, or its steps weigh twice.
-- doc: Recordings whose commands and wheel speeds are those of another one at one constant shift of their clocks, whatever their profiles take for the pose, the goal and the actions.
WITH seen AS (
    SELECT recording_id, content, min(stamp_ns) AS stamp_ns
    FROM (
        SELECT
            recording_id,
            stamp_ns,
            hash(round(command_speed_mps, 3), round(command_yaw_rate_radps, 3), round(wheel_speed_mps, 4), round(wheel_yaw_rate_radps, 4)) AS content
        FROM transitions
        WHERE wheel_speed_mps <> 0 OR wheel_yaw_rate_radps <> 0
    )
    GROUP BY recording_id, content
    HAVING count(*) = 1
), ranked AS (
    SELECT
        *,
        row_number() OVER (PARTITION BY content ORDER BY recording_id) AS place,
        count(*) OVER (PARTITION BY content) AS recordings
    FROM seen
), matches AS (
    -- What many recordings hold is compared with the first of them only: pairs grow with the square.
    SELECT
        one.recording_id,
        other.recording_id AS same_as,
        other.stamp_ns - one.stamp_ns AS later_ns
    FROM (FROM ranked WHERE recordings > 1 AND (place = 1 OR recordings <= 5)) AS one
    JOIN (FROM ranked WHERE recordings > 1) AS other
        ON other.content = one.content AND one.recording_id < other.recording_id
), shifted AS (
    SELECT *, quantile_disc(later_ns, 0.5) OVER (PARTITION BY recording_id, same_as) AS shift_ns
    FROM matches
), counts AS (
    SELECT recording_id, source_file, distinctive
    FROM (SELECT recording_id, count(*) AS distinctive FROM seen GROUP BY recording_id)
    JOIN (SELECT recording_id, any_value(source_file) AS source_file FROM transitions GROUP BY recording_id)
        USING (recording_id)
)
SELECT
    shifted.recording_id,
    any_value(one.source_file) AS source_file,
    same_as,
    any_value(other.source_file) AS same_as_file,
    count(*) AS rows,
    count(*) / least(any_value(one.distinctive), any_value(other.distinctive)) AS share,
    any_value(shift_ns) / 1e9 AS later_s
FROM shifted
JOIN counts AS one ON one.recording_id = shifted.recording_id
JOIN counts AS other ON other.recording_id = shifted.same_as
WHERE abs(later_ns - shift_ns) <= 100000000
GROUP BY shifted.recording_id, same_as
HAVING count(*) >= $min_rows
    AND count(*) / least(any_value(one.distinctive), any_value(other.distinctive)) >= $min_share
ORDER BY rows DESC, shifted.recording_id, same_as
