-- severity: warning
-- advice: Record the commands. Until then, panels leave out these rows, unless the mixture sets odometry_as_command = true: an action that is the measured motion already contains the outcome, and hides slip.
-- doc: Recordings whose actions are the measured motion, as no command was recorded.
SELECT recording_id, source_file, transitions, stand_in.instead
FROM (SELECT recording_id, source_file, transitions, unnest(stand_ins) AS stand_in FROM recordings)
WHERE stand_in.input = 'command'
ORDER BY source_file, recording_id
