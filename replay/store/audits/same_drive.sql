-- severity: warning
-- advice: One drive was likely recorded twice (replayed, or by another profile): take one of the two recordings out, or its steps weigh twice.
-- doc: Recordings whose commands and wheel speeds are those of another one at one constant shift of their clocks, whatever their profiles take for the pose, the goal and the actions.
WITH moving AS NOT MATERIALIZED (
    SELECT
        recording_id,
        stamp_ns,
        hash(round(command_speed_mps, 3), round(command_yaw_rate_radps, 3), round(wheel_speed_mps, 4), round(wheel_yaw_rate_radps, 4)) AS content
    FROM transitions
    WHERE wheel_speed_mps <> 0 OR wheel_yaw_rate_radps <> 0
), shared AS (
    -- Few contents are of several recordings, and only theirs are grouped by recording.
    SELECT content FROM moving GROUP BY content HAVING min(hash(recording_id)) < max(hash(recording_id))
), ranked AS (
    SELECT
        *,
        row_number() OVER (PARTITION BY content ORDER BY recording_id) AS place,
        count(*) OVER (PARTITION BY content) AS recordings
    FROM (
        SELECT recording_id, content, min(stamp_ns) AS stamp_ns
        FROM moving
        SEMI JOIN shared USING (content)
        GROUP BY recording_id, content
        HAVING count(*) = 1
    )
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
), pairs AS (
    SELECT recording_id, same_as, count(*) AS rows, any_value(shift_ns) / 1e9 AS later_s
    FROM shifted
    WHERE abs(later_ns - shift_ns) <= 100000000
    GROUP BY recording_id, same_as
    HAVING count(*) >= $min_rows
), counts AS (
    SELECT recording_id, count(*) AS distinctive
    FROM (
        SELECT recording_id
        FROM moving
        WHERE recording_id IN (SELECT unnest([recording_id, same_as]) FROM pairs)
        GROUP BY recording_id, content
        HAVING count(*) = 1
    )
    GROUP BY recording_id
)
SELECT
    pairs.recording_id,
    file.source_file,
    same_as,
    other_file.source_file AS same_as_file,
    rows,
    rows / least(one.distinctive, other.distinctive) AS share,
    later_s
FROM pairs
JOIN counts AS one ON one.recording_id = pairs.recording_id
JOIN counts AS other ON other.recording_id = same_as
LEFT JOIN recordings AS file ON file.recording_id = pairs.recording_id
LEFT JOIN recordings AS other_file ON other_file.recording_id = same_as
WHERE rows / least(one.distinctive, other.distinctive) >= $min_share
ORDER BY rows DESC, pairs.recording_id, same_as
