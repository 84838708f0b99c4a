-- The manifest of the ingest that wrote a row, else of the ingest that replaced it.
FROM stored_recordings
WHERE ingest_id = $ingest OR recording_id = $recording
ORDER BY ingest_id = $ingest DESC, ingested_at DESC
LIMIT 1
