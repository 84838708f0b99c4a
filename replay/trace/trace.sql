-- One transition as stored. It is read from the files, because the views hide rows of recordings that were
-- replaced later.
SELECT
    * REPLACE (observation::FLOAT[] AS observation, next_observation::FLOAT[] AS next_observation)
FROM stored_transitions
WHERE transition_id = $id
