-- What two stores have of each recording, episode and row: `a` and `b` are the schemas of their views.
-- An ingest is written once and never changed, so rows of the same ingest are the same, unread.
CREATE TEMP TABLE recording_pairs AS
SELECT
    recording_id,
    one.ingest_id AS ingest_a,
    other.ingest_id AS ingest_b,
    coalesce(other.source_file, one.source_file) AS source_file,
    CASE
        WHEN one.ingest_id IS NULL THEN 'in'
        WHEN other.ingest_id IS NULL THEN 'out'
        WHEN one.ingest_id = other.ingest_id THEN 'same'
        ELSE 'written again'
    END AS change
FROM a.recordings AS one
FULL JOIN b.recordings AS other USING (recording_id);

-- Only what was written again is read whole; a match of all columns is a match of the episode.
CREATE TEMP TABLE episode_pairs AS
WITH of_a AS (
    SELECT
        recording_id,
        episode_id,
        episode_index,
        min(stamp_ns) AS start_ns,
        (max(stamp_ns) - min(stamp_ns)) / 1e9 AS duration_s,
        count(*) AS rows
    FROM a.transitions
    GROUP BY ALL
), of_b AS (
    SELECT
        recording_id,
        episode_id,
        episode_index,
        min(stamp_ns) AS start_ns,
        (max(stamp_ns) - min(stamp_ns)) / 1e9 AS duration_s,
        count(*) AS rows
    FROM b.transitions
    GROUP BY ALL
), content_a AS (
    SELECT episode_id, bit_xor(hash(step_index, stamp_ns, action, reward, terminated, truncated,
        observation::FLOAT[], next_observation::FLOAT[])) AS content
    FROM a.transitions
    WHERE recording_id IN (SELECT recording_id FROM recording_pairs WHERE change = 'written again')
    GROUP BY episode_id
), content_b AS (
    SELECT episode_id, bit_xor(hash(step_index, stamp_ns, action, reward, terminated, truncated,
        observation::FLOAT[], next_observation::FLOAT[])) AS content
    FROM b.transitions
    WHERE recording_id IN (SELECT recording_id FROM recording_pairs WHERE change = 'written again')
    GROUP BY episode_id
), numbered_a AS (
    -- A clock that was set back can begin two episodes at one stamp.
    SELECT *, row_number() OVER (PARTITION BY recording_id, start_ns ORDER BY episode_index) AS place
    FROM of_a
    LEFT JOIN content_a USING (episode_id)
), numbered_b AS (
    SELECT *, row_number() OVER (PARTITION BY recording_id, start_ns ORDER BY episode_index) AS place
    FROM of_b
    LEFT JOIN content_b USING (episode_id)
)
SELECT
    row_number() OVER (ORDER BY recording_id, start_ns, place) - 1 AS number,
    recording_id,
    one.episode_id AS episode_a,
    other.episode_id AS episode_b,
    coalesce(one.rows, 0) AS rows_a,
    coalesce(other.rows, 0) AS rows_b,
    coalesce(one.duration_s, 0) AS duration_a_s,
    coalesce(other.duration_s, 0) AS duration_b_s,
    CASE
        WHEN one.episode_id IS NULL THEN 'in'
        WHEN other.episode_id IS NULL THEN 'out'
        WHEN one.content IS DISTINCT FROM other.content OR one.rows <> other.rows THEN 'changed'
        ELSE 'same'
    END AS change
FROM numbered_a AS one
FULL JOIN numbered_b AS other USING (recording_id, start_ns, place);

-- Rows of both, where one was written again: by id, else by recording and stamp.
CREATE TEMP TABLE row_pairs AS
WITH of_a AS (
    SELECT transition_id, recording_id, stamp_ns, episode_id, primary_condition AS condition, conditions
    FROM a.transitions
    WHERE recording_id IN (SELECT recording_id FROM recording_pairs WHERE change = 'written again')
), of_b AS (
    SELECT transition_id, recording_id, stamp_ns, episode_id, primary_condition AS condition, conditions
    FROM b.transitions
    WHERE recording_id IN (SELECT recording_id FROM recording_pairs WHERE change = 'written again')
), by_id AS (
    SELECT
        of_a.transition_id AS row_a,
        of_b.transition_id AS row_b,
        of_b.recording_id AS recording_id,
        of_b.episode_id AS episode_id,
        of_a.condition AS condition_a,
        of_b.condition AS condition_b,
        of_a.conditions AS conditions_a,
        of_b.conditions AS conditions_b
    FROM of_a
    JOIN of_b USING (transition_id)
    WHERE abs(of_a.stamp_ns - of_b.stamp_ns) < 500_000_000 -- else the steps are others: a new clock
), left_a AS (
    SELECT recording_id, stamp_ns, any_value(transition_id) AS transition_id,
        any_value(condition) AS condition, any_value(conditions) AS conditions
    FROM of_a
    WHERE transition_id NOT IN (SELECT row_a FROM by_id)
    GROUP BY recording_id, stamp_ns
    HAVING count(*) = 1
), left_b AS (
    SELECT recording_id, stamp_ns, any_value(transition_id) AS transition_id,
        any_value(episode_id) AS episode_id,
        any_value(condition) AS condition, any_value(conditions) AS conditions
    FROM of_b
    WHERE transition_id NOT IN (SELECT row_b FROM by_id)
    GROUP BY recording_id, stamp_ns
    HAVING count(*) = 1
)
FROM by_id
UNION ALL
SELECT left_a.transition_id, left_b.transition_id, recording_id, left_b.episode_id,
    left_a.condition, left_b.condition, left_a.conditions, left_b.conditions
FROM left_a
JOIN left_b USING (recording_id, stamp_ns);
