-- The steps before and after one of an episode: what its reward is made of needs both.
SELECT * EXCLUDE (observation, next_observation)
FROM stored_transitions
WHERE episode_id = $episode AND step_index BETWEEN $step - 1 AND $step + 1
ORDER BY step_index
