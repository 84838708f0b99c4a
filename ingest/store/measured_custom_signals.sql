-- One value per episode for each of a profile's own signals; other signals are in measured_signals.sql.
-- Planning takes as long as for measured_signals.sql, so summaries skip it if no profile has own signals.
WITH own_signals AS (
    -- include: custom_signals.sql
), told AS (
    SELECT
        recording_id,
        episode_id,
        signal,
        json_extract_string(to_json(rows), '$."' || signal || '"') AS told
    FROM (SELECT * EXCLUDE (observation, next_observation) FROM transitions) AS rows
    CROSS JOIN own_signals
), summed AS (
    SELECT
        recording_id,
        episode_id,
        signal,
        avg(value) AS value,
        count(value) AS steps
    FROM (
        SELECT
            recording_id,
            episode_id,
            signal,
            -- A flag becomes 0 or 1; other text becomes null.
            coalesce(
                TRY_CAST(told AS DOUBLE), CASE told WHEN 'true' THEN 1 WHEN 'false' THEN 0 END
            ) AS value
        FROM told
    )
    GROUP BY recording_id, episode_id, signal
)
SELECT recording_id, episode_id, signal, value, steps
FROM summed
WHERE isfinite(value) AND steps > 0
