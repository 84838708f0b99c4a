-- Rows whose content is unique in their recording and also in another recording. The content is a hash of task,
-- action, observation and pose, rounded to a thousandth; stamps do not count, as each ingest estimates its own
-- clock. This view scans the rows; if manifests have the hashes, same_drives.py reads only those.
CREATE OR REPLACE VIEW shared_rows AS
WITH places AS (
    -- Hashes of task, action and pose that are in several recordings: only their rows are read whole.
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
