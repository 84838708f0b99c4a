-- severity: warning
-- advice: These rows do not show what other actions lead to, so a policy cannot learn it: ingest drives that turn and stop, or compare `actions` in the profile with the recorded commands.
-- doc: Recordings in which (almost) all rows have the same action.
SELECT recording_id, source_file, action, name AS action_name, rows, rows / of_recording AS share
FROM (
    SELECT
        recording_id,
        action,
        CAST(sum(rows) AS BIGINT) AS rows,
        sum(sum(rows)) OVER (PARTITION BY recording_id) AS of_recording
    FROM recording_cells
    GROUP BY recording_id, action
)
JOIN (SELECT recording_id, source_file, task_hash FROM recordings) USING (recording_id)
LEFT JOIN (SELECT task_hash, action, name FROM actions) USING (task_hash, action)
WHERE rows / of_recording >= $max_share AND of_recording >= $min_rows
ORDER BY share DESC, recording_id
