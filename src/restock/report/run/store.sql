-- What the report shows of the store that the run's panel came from.

-- name: visited
-- Logged steps per cell of the map.
SELECT floor(pose_x_m / $cell_m) * $cell_m AS x_m,
       floor(pose_y_m / $cell_m) * $cell_m AS y_m,
       count(*) AS rows
FROM transitions
GROUP BY ALL
ORDER BY ALL;

-- name: rare
-- Where a rare condition was logged; every one, up to $most drawn the same way each time.
SELECT pose_x_m AS x_m, pose_y_m AS y_m, condition
FROM transitions
WHERE condition <> 'nominal'
ORDER BY hash(transition_id)
LIMIT $most;

-- name: recordings
SELECT source_file, format, duration_s, steps, episodes, transitions, recording_id, profile,
       profile_hash, labels_version, restock_version
FROM recordings
ORDER BY source_file;

-- name: labels
-- How good the labels are, where a simulator knew what was true, and how many are uncertain.
SELECT scores.*, uncertain.share AS uncertain_share
FROM pooled_label_scores AS scores
LEFT JOIN (
    SELECT condition, count(*) / (SELECT count(*) FROM transitions) AS share
    FROM (SELECT unnest(uncertain) AS condition FROM transitions)
    GROUP BY condition
) AS uncertain USING (condition)
ORDER BY condition;

-- name: reliability
SELECT condition, from_probability, mean_probability, true_share, known
FROM label_reliability
WHERE known > 0
ORDER BY condition, from_probability;

-- name: logged
-- The conditions that logged episodes met: the nearest thing to deployment that there is. An
-- episode that met several counts for each; one that met none is nominal.
WITH met AS (
    SELECT episode_id, list_distinct(flatten(list(conditions))) AS met FROM transitions GROUP BY ALL
), each AS (
    SELECT episode_id, unnest(CASE WHEN len(met) = 0 THEN ['nominal'] ELSE met END) AS condition
    FROM met
)
SELECT condition, count(*) AS episodes, count(*) / sum(count(*)) OVER () AS share
FROM each
GROUP BY condition
ORDER BY episodes DESC, condition;
