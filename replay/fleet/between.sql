-- Compares the recordings, episodes and rows of two stores, whose views are in the schemas `a` and `b`.
CREATE TEMP VIEW both_rows AS
SELECT 'a' AS side, transition_id, recording_id, episode_id, episode_index, step_index, stamp_ns, action,
    reward, terminated, truncated, observation::FLOAT[] AS observation,
    next_observation::FLOAT[] AS next_observation, primary_condition AS condition, conditions
FROM a.transitions
UNION ALL
SELECT 'b', transition_id, recording_id, episode_id, episode_index, step_index, stamp_ns, action,
    reward, terminated, truncated, observation::FLOAT[], next_observation::FLOAT[], primary_condition,
    conditions
FROM b.transitions;

-- An ingest is written once and never changes, so rows with the same ingest_id are equal without reading.
CREATE TEMP TABLE recording_pairs AS
SELECT
    recording_id,
    coalesce(other.source_file, one.source_file) AS source_file,
    CASE
        WHEN one.ingest_id IS NULL THEN 'in'
        WHEN other.ingest_id IS NULL THEN 'out'
        WHEN one.ingest_id = other.ingest_id THEN 'same'
        ELSE 'written again'
    END AS change
FROM a.recordings AS one
FULL JOIN b.recordings AS other USING (recording_id);

-- All columns are compared only for recordings that were written again, by a hash per episode.
CREATE TEMP TABLE episode_pairs AS
WITH episodes AS (
    SELECT
        side,
        recording_id,
        episode_id,
        episode_index,
        min(stamp_ns) AS start_ns,
        (max(stamp_ns) - min(stamp_ns)) / 1e9 AS duration_s,
        count(*) AS rows
    FROM both_rows
    GROUP BY ALL
), contents AS (
    SELECT side, episode_id, bit_xor(hash(step_index, stamp_ns, action, reward, terminated, truncated,
        observation, next_observation)) AS content
    FROM both_rows
    WHERE recording_id IN (SELECT recording_id FROM recording_pairs WHERE change = 'written again')
    GROUP BY ALL
), numbered AS (
    -- If a clock was set back, two episodes can begin at the same stamp.
    SELECT *, row_number() OVER (
        PARTITION BY side, recording_id, start_ns ORDER BY episode_index
    ) AS place
    FROM episodes
    LEFT JOIN contents USING (side, episode_id)
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
FROM (FROM numbered WHERE side = 'a') AS one
FULL JOIN (FROM numbered WHERE side = 'b') AS other USING (recording_id, start_ns, place);

-- Pairs of equal steps in recordings that were written again: by id, else by recording and stamp.
CREATE TEMP TABLE row_pairs AS
WITH again AS (
    SELECT side, transition_id, recording_id, stamp_ns, episode_id, condition, conditions
    FROM both_rows
    WHERE recording_id IN (SELECT recording_id FROM recording_pairs WHERE change = 'written again')
), by_id AS (
    SELECT
        transition_id,
        other.recording_id AS recording_id,
        other.episode_id AS episode_id,
        one.condition AS condition_a,
        other.condition AS condition_b,
        one.conditions AS conditions_a,
        other.conditions AS conditions_b
    FROM (FROM again WHERE side = 'a') AS one
    JOIN (FROM again WHERE side = 'b') AS other USING (transition_id)
    WHERE abs(one.stamp_ns - other.stamp_ns) < 500_000_000 -- else the id is of another step: a new clock
), others AS (
    SELECT side, recording_id, stamp_ns, any_value(episode_id) AS episode_id,
        any_value(condition) AS condition, any_value(conditions) AS conditions
    FROM again
    WHERE transition_id NOT IN (SELECT transition_id FROM by_id)
    GROUP BY side, recording_id, stamp_ns
    HAVING count(*) = 1
)
SELECT * EXCLUDE (transition_id) FROM by_id
UNION ALL
SELECT recording_id, other.episode_id, one.condition, other.condition, one.conditions, other.conditions
FROM (FROM others WHERE side = 'a') AS one
JOIN (FROM others WHERE side = 'b') AS other USING (recording_id, stamp_ns);

-- Recordings that differ. Equal rows with another ingest_id do not count as a difference.
CREATE TEMP VIEW recording_changes AS
SELECT * FROM (
    SELECT
        any_value(pair.change) AS change,
        recording_id,
        any_value(source_file) AS source_file,
        count(*) FILTER (rows_a > 0) AS episodes_a,
        count(*) FILTER (rows_b > 0) AS episodes_b,
        coalesce(sum(rows_a), 0)::BIGINT AS rows_a,
        coalesce(sum(rows_b), 0)::BIGINT AS rows_b,
        count(*) FILTER (episode.change <> 'same') AS episodes_changed
    FROM recording_pairs AS pair
    LEFT JOIN episode_pairs AS episode USING (recording_id)
    WHERE pair.change <> 'same'
    GROUP BY recording_id
)
LEFT JOIN (
    SELECT recording_id, count(*) AS rows_relabelled
    FROM row_pairs
    WHERE condition_a IS DISTINCT FROM condition_b
        OR list_sort(conditions_a) IS DISTINCT FROM list_sort(conditions_b)
    GROUP BY recording_id
) USING (recording_id)
WHERE change <> 'written again' OR episodes_changed > 0 OR rows_relabelled > 0
ORDER BY change, source_file, recording_id;

CREATE TEMP VIEW episode_changes AS
SELECT change, recording_id, episode_a, episode_b, rows_a, rows_b
FROM episode_pairs
WHERE change <> 'same'
ORDER BY change, recording_id, number;

CREATE TEMP VIEW episode_counts AS
SELECT
    count(*) FILTER (change = 'in') AS "in",
    count(*) FILTER (change = 'out') AS "out",
    count(*) FILTER (change = 'changed') AS changed,
    count(*) FILTER (change = 'same') AS same
FROM episode_pairs;

CREATE TEMP VIEW label_changes AS
SELECT condition_a AS "from", condition_b AS "to", count(*) AS rows,
    count(DISTINCT episode_id) AS episodes
FROM row_pairs
WHERE condition_a IS DISTINCT FROM condition_b
GROUP BY ALL
ORDER BY rows DESC, condition_a, condition_b;

CREATE TEMP VIEW label_counts AS
SELECT
    count(*) AS rows_compared,
    count(*) FILTER (condition_a IS DISTINCT FROM condition_b) AS rows_changed,
    count(*) FILTER (
        condition_a IS NOT DISTINCT FROM condition_b
        AND list_sort(conditions_a) IS DISTINCT FROM list_sort(conditions_b)
    ) AS rows_with_other_changes
FROM row_pairs;

-- Shares of each value, by column. `share_values` (store_difference.py) has a row per step and column.
CREATE TEMP VIEW share_changes AS
WITH counted AS (
    SELECT place, "of", value, count(*) FILTER (side = 'a') AS rows_a, count(*) FILTER (side = 'b') AS rows_b
    FROM share_values
    GROUP BY ALL
), shared AS (
    SELECT
        *,
        rows_a / nullif(sum(rows_a) OVER column_rows, 0) AS share_a,
        rows_b / nullif(sum(rows_b) OVER column_rows, 0) AS share_b
    FROM counted
    WINDOW column_rows AS (PARTITION BY "of")
)
SELECT * EXCLUDE (place), share_b - share_a AS difference
FROM shared
QUALIFY count(*) OVER (PARTITION BY "of") > 1 OR value <> '(none)'
ORDER BY place, value;

-- Conditions with different definitions, and different versions of labels, profiles and software.
CREATE TEMP VIEW definition_changes AS
SELECT
    'condition ' || condition AS what,
    one.timing || ', priority ' || one.priority || ': ' || one.sql AS a,
    other.timing || ', priority ' || other.priority || ': ' || other.sql AS b
FROM a.conditions AS one
FULL JOIN b.conditions AS other USING (condition)
WHERE a IS DISTINCT FROM b
UNION ALL
SELECT
    what,
    string_agg(DISTINCT value, ', ' ORDER BY value) FILTER (side = 'a') AS a,
    string_agg(DISTINCT value, ', ' ORDER BY value) FILTER (side = 'b') AS b
FROM (
    UNPIVOT (
        SELECT 'a' AS side, labels_version, profile_hash, restock_version FROM a.versions
        UNION ALL
        SELECT 'b', labels_version, profile_hash, restock_version FROM b.versions
    ) ON labels_version, profile_hash, restock_version INTO NAME what VALUE value
)
GROUP BY what
HAVING a IS DISTINCT FROM b
ORDER BY what;
