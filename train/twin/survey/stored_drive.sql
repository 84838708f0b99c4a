-- The recordings of a store that have rows, those with the most rows first.
SELECT recording_id, source_file, profile_toml, rows_
FROM recordings
JOIN (SELECT recording_id, count(*) AS rows_ FROM transitions GROUP BY recording_id)
    USING (recording_id)
ORDER BY rows_ DESC, recording_id;
