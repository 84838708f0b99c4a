-- Every row of one task, in the order it was driven.
SELECT * EXCLUDE (observation, next_observation)
FROM transitions
WHERE task_hash = $task
ORDER BY recording_id, episode_index, step_index;
