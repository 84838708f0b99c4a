-- Rows that look like no other of their recording, and like one of another recording: by content (task,
-- action, observation and pose, rounded to a thousandth), not by stamp, as each ingest estimates its own
-- clock. From the rows; where manifests have the content of theirs (same_drives.py), nothing is read but
-- that.
CREATE OR REPLACE VIEW shared_rows AS
WITH places AS (
    -- Few rows pass this, and only theirs are read whole.
    SELECT hash(task_hash, action, round(pose_x_m, 3), round(pose_y_m, 3)) AS place
    FROM transitions
    GROUP BY ALL
    HAVING min(hash(recording_id)) < max(hash(recording_id))
), distinctive AS MATERIALIZED (
    SELECT recording_id, content, any_value(transition_id) AS transition_id
    FROM (
        SELECT
            recording_id,
            transition_id,
            hash(
                task_hash,
                action,
                list_transform(observation::FLOAT[], lambda x: round(x, 3)),
                round(pose_x_m, 3),
                round(pose_y_m, 3)
            )::UBIGINT AS content
        FROM transitions
        WHERE hash(task_hash, action, round(pose_x_m, 3), round(pose_y_m, 3)) IN (FROM places)
    )
    GROUP BY recording_id, content
    HAVING count(*) = 1
)
SELECT recording_id, transition_id, content
FROM distinctive
SEMI JOIN (SELECT content FROM distinctive GROUP BY content HAVING count(*) > 1) USING (content);
