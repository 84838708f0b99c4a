-- severity: warning
-- advice: One drive was likely recorded twice (replayed, or by another profile): take one of the two recordings out, or its steps weigh twice.
-- doc: Recordings whose commands and wheel speeds are those of another one at one constant shift of their clocks, whatever their profiles take for the pose, the goal and the actions.
WITH seen AS (
    SELECT recording_id, content, min(stamp_ns) AS stamp_ns, any_value(source_file) AS source_file
    FROM (
        SELECT
            recording_id,
            source_file,
            stamp_ns,
            hash(round(command_speed_mps, 3), round(command_yaw_rate_radps, 3), round(wheel_speed_mps, 4), round(wheel_yaw_rate_radps, 4)) AS content
        FROM transitions
        WHERE wheel_speed_mps <> 0 OR wheel_yaw_rate_radps <> 0
    )
    GROUP BY recording_id, content
    HAVING count(*) = 1
), matches AS (
    SELECT
        one.recording_id,
        one.source_file,
        other.recording_id AS same_as,
        other.source_file AS same_as_file,
        other.stamp_ns - one.stamp_ns AS later_ns
    FROM seen AS one
    JOIN seen AS other ON other.content = one.content AND one.recording_id < other.recording_id
), shifted AS (
    SELECT *, quantile_disc(later_ns, 0.5) OVER (PARTITION BY recording_id, same_as) AS shift_ns
    FROM matches
), counts AS (
    SELECT recording_id, count(*) AS distinctive FROM seen GROUP BY recording_id
)
SELECT
    shifted.recording_id,
    any_value(source_file) AS source_file,
    same_as,
    any_value(same_as_file) AS same_as_file,
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
