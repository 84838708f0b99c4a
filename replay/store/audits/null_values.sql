-- severity: error
-- advice: Ingest this recording again with this version of Restock. If rows still lack values, the profile reads a broken topic.
-- doc: Rows without a required value.
SELECT transition_id, recording_id, episode_id, step_index
FROM flawed_rows
WHERE is_null
ORDER BY transition_id
