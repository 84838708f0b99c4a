-- severity: error
-- advice: Ingest this recording again with this version; if it stays, its profile reads a broken topic.
-- doc: Rows that lack a value no row may lack.
SELECT transition_id, recording_id, episode_id, step_index
FROM transitions
WHERE observation IS NULL
    OR next_observation IS NULL
    OR action IS NULL
    OR reward IS NULL
    OR terminated IS NULL
    OR truncated IS NULL
    OR condition IS NULL
    OR conditions IS NULL
    OR behaviour_policy IS NULL
    OR stamp_ns IS NULL
    OR list_contains(observation::FLOAT[], NULL)
    OR list_contains(next_observation::FLOAT[], NULL)
