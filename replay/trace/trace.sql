-- One transition as stored. It is read from the files, because the views hide rows of recordings that were
-- replaced later.
FROM stored_transitions
WHERE transition_id = $id
