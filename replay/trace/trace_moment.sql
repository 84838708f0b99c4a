-- The steps of a recording in a stretch of time, by the ingest that wrote the row in question.
SELECT
    * REPLACE (observation::FLOAT[] AS observation, next_observation::FLOAT[] AS next_observation)
FROM stored_transitions
WHERE recording_id = $recording AND ingest_id = $ingest AND stamp_ns BETWEEN $low AND $high
ORDER BY stamp_ns, transition_id
