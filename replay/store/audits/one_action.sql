-- severity: warning
-- advice: Nothing in these rows says what another action leads to, so a policy learns none: ingest drives that turn and stop, or check `actions` of the profile against its commands.
-- doc: Recordings (almost) all of whose rows have one and the same action.
SELECT recording_id, source_file, action, rows, rows / of_recording AS share
FROM (
    SELECT
        recording_id,
        action,
        CAST(sum(rows) AS BIGINT) AS rows,
        sum(sum(rows)) OVER (PARTITION BY recording_id) AS of_recording
    FROM recording_cells
    GROUP BY recording_id, action
)
JOIN (SELECT recording_id, source_file FROM recordings) USING (recording_id)
WHERE rows / of_recording >= $max_share AND of_recording >= $min_rows
ORDER BY share DESC, recording_id
