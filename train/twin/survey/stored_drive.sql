-- The recordings of a store, the one with the most rows first. `profile_toml` is null in a store
-- from before it was kept.
SELECT recording_id, source_file, profile_toml, rows_
FROM (
    FROM (FROM recordings UNION ALL BY NAME SELECT NULL::VARCHAR AS profile_toml WHERE false)
    SELECT recording_id, source_file, profile_toml
)
JOIN (SELECT recording_id, count(*) AS rows_ FROM transitions GROUP BY recording_id)
    USING (recording_id)
ORDER BY rows_ DESC, recording_id;
