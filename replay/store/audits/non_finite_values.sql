-- severity: error
-- advice: One such row makes all weights of the network NaN: leave it out with the mixture's `where`, and correct the profile.
-- doc: Rows with NaN or infinity in an observation or the reward.
SELECT transition_id, recording_id, episode_id, step_index
FROM flawed_rows
WHERE is_not_finite
ORDER BY transition_id
