-- severity: warning
-- advice: If only conditions changed, run `restock store label STORE --profile PROFILE`; otherwise ingest these recordings again.
-- doc: Recordings with another version of the conditions or of the profile than the newest ingest with a profile of the same name.
WITH newest AS (
    FROM recordings
    QUALIFY row_number() OVER (PARTITION BY profile ORDER BY ingested_at DESC, ingest_id) = 1
)
SELECT recordings.recording_id, recordings.source_file, recordings.labels_version, recordings.profile_hash
FROM recordings
JOIN newest USING (profile)
WHERE
    -- Compare the rules only: corrections follow a plus sign, and differ from recording to recording.
    split_part(recordings.labels_version, '+', 1) <> split_part(newest.labels_version, '+', 1)
    OR recordings.profile_hash <> newest.profile_hash
ORDER BY recordings.source_file
