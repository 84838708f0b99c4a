-- A step of an episode and its neighbours, which are needed to compute the parts of its reward.
SELECT * EXCLUDE (observation, next_observation)
FROM stored_transitions
WHERE episode_id = $episode AND step_index BETWEEN $step - 1 AND $step + 1
ORDER BY step_index
