-- Pairs of recordings with the same commands and wheel speeds, whatever their profiles use as pose and goal.
--
-- Only rows in which the robot moves are compared, and only contents that occur once in their recording. For each
-- pair, the median shift between stamps is computed, and rows within .1 s of it count. A pair is reported from 2 such
-- rows on, if they are a tenth of the smaller recording's. If a content is in more than 5 recordings, only pairs
-- with the first are compared: all pairs would be too many. `same_as` sorts after `recording_id`.
CREATE OR REPLACE VIEW same_drives AS
WITH moving AS (
    SELECT
        recording_id,
        stamp_ns,
        hash(
            round(command_speed_mps, 3),
            round(command_yaw_rate_radps, 3),
            round(wheel_speed_mps, 4),
            round(wheel_yaw_rate_radps, 4)
        ) AS content
    FROM transitions
    WHERE wheel_speed_mps <> 0 OR wheel_yaw_rate_radps <> 0
), contents AS MATERIALIZED (
    SELECT
        content,
        count(*) AS rows,
        min(hash(recording_id)) AS recording,
        max(hash(recording_id)) AS last_recording
    FROM moving
    GROUP BY content
), shared AS MATERIALIZED (
    SELECT recording_id, content, any_value(stamp_ns) AS stamp_ns
    FROM moving
    SEMI JOIN (FROM contents WHERE recording < last_recording) USING (content)
    GROUP BY recording_id, content
    HAVING count(*) = 1
), sizes AS ( -- contents that occur once in a recording
    SELECT recording, sum(size) AS size
    FROM (
        SELECT recording, count(*) AS size FROM contents WHERE rows = 1 GROUP BY recording
        UNION ALL
        SELECT hash(recording_id), count(*) FROM shared GROUP BY recording_id
    )
    GROUP BY recording
), numbered AS MATERIALIZED (
    SELECT
        *,
        row_number() OVER (PARTITION BY content ORDER BY recording_id) AS place,
        count(*) OVER (PARTITION BY content) AS copies
    FROM shared
), matches AS MATERIALIZED (
    SELECT one.recording_id AS recording_id, other.recording_id AS same_as, other.stamp_ns - one.stamp_ns AS later_ns
    FROM numbered AS other
    JOIN (FROM numbered WHERE (place = 1 AND copies > 1) OR copies <= 5) AS one
        ON one.content = other.content AND one.place < other.place
), shifts AS (
    SELECT recording_id, same_as, quantile_disc(later_ns, 0.5) AS shift_ns
    FROM matches
    GROUP BY recording_id, same_as
    HAVING count(*) > 1
), near AS (
    SELECT recording_id, same_as, shift_ns, count(*) AS rows
    FROM matches
    JOIN shifts USING (recording_id, same_as)
    WHERE abs(later_ns - shift_ns) <= 100_000_000
    GROUP BY recording_id, same_as, shift_ns
)
SELECT
    recording_id,
    same_as,
    rows,
    rows / least(one.size, other.size) AS share,
    shift_ns / 1e9 AS later_s
FROM near
JOIN sizes AS one ON one.recording = hash(recording_id)
JOIN sizes AS other ON other.recording = hash(same_as)
WHERE rows >= 2 AND share >= 0.1;
