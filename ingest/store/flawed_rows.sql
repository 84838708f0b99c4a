-- Rows with NaN or infinite values, which would break a network, or without a required value. From
-- `transitions`. Included in two statements: the view that scans rows, and the summary in a manifest.
SELECT transition_id, recording_id, episode_id, step_index, is_null, is_not_finite
FROM (
    SELECT
        transition_id,
        recording_id,
        episode_id,
        step_index,
        observation IS NULL
        OR next_observation IS NULL
        OR action IS NULL
        OR reward IS NULL
        OR terminated IS NULL
        OR truncated IS NULL
        OR primary_condition IS NULL
        OR conditions IS NULL
        OR behaviour_policy IS NULL
        OR stamp_ns IS NULL
        OR list_count(observation::FLOAT[]) < len(observation)
        OR list_count(next_observation::FLOAT[]) < len(next_observation) AS is_null,
        -- NaN and infinity survive a sum.
        coalesce(
            NOT isfinite(list_sum(observation::FLOAT[]) + list_sum(next_observation::FLOAT[])),
            false
        )
        OR NOT coalesce(isfinite(reward), true) AS is_not_finite
    FROM transitions
)
WHERE is_null OR is_not_finite
