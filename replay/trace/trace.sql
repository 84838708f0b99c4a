-- One transition as it lies in the store: straight from the files, for the views hide rows whose
-- recording was replaced since.
SELECT
    * REPLACE (observation::FLOAT[] AS observation, next_observation::FLOAT[] AS next_observation)
FROM stored_transitions
WHERE transition_id = $id
