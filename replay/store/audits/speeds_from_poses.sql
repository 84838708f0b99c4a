-- severity: warning
-- advice: Record odometry. Speeds from poses are late by half a window, and slip cannot be detected in them.
-- doc: Recordings whose speeds come from poses, as no odometry was recorded.
SELECT recording_id, source_file, transitions, stand_in.instead
FROM (SELECT recording_id, source_file, transitions, unnest(stand_ins) AS stand_in FROM recordings)
WHERE stand_in.input = 'wheels'
ORDER BY source_file, recording_id
