-- severity: warning
-- advice: Nothing in these rows says what another action leads to, so a policy learns none: ingest drives that turn and stop, or check `actions` of the profile against its commands.
-- doc: Recordings (almost) all of whose rows have one and the same action.
SELECT recording_id, source_file, action, rows, rows / of_recording AS share
FROM (
    SELECT
        recording_id,
        any_value(source_file) AS source_file,
        action,
        count(*) AS rows,
        sum(count(*)) OVER (PARTITION BY recording_id) AS of_recording
    FROM transitions
    GROUP BY recording_id, action
)
WHERE rows / of_recording >= $max_share AND of_recording >= $min_rows
ORDER BY share DESC, recording_id
