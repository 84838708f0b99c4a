-- severity: warning
-- advice: Where only conditions changed, `restock label STORE --profile PROFILE`; else ingest these recordings again.
-- doc: Recordings that were labelled, or read, by another version of the conditions or the profile than the newest ingest.
WITH newest AS (FROM recordings ORDER BY ingested_at DESC, ingest_id LIMIT 1)
SELECT recordings.recording_id, recordings.source_file, recordings.labels_version, recordings.profile_hash
FROM recordings, newest
WHERE recordings.profile = newest.profile
    AND (
        -- Of the rules alone: corrections stand behind a plus, and are each recording's own.
        split_part(recordings.labels_version, '+', 1) <> split_part(newest.labels_version, '+', 1)
        OR recordings.profile_hash <> newest.profile_hash
    )
ORDER BY recordings.source_file
