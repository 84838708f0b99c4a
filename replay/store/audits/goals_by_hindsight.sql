-- severity: info
-- advice: Their successes are not counted. Returns and actions can be learned from, but returns say little about the driver, as the goal was set afterwards to where the robot arrived. Record the goal topic if there is one.
-- doc: Recordings without recorded goals: each goal was set to where the robot arrived, so every mission arrives by construction.
SELECT
    source_file,
    recording_id,
    count(*) AS episodes,
    count(*) FILTER (WHERE ended_by = 'goal') AS arrived,
    count(*) FILTER (WHERE ended = 'truncated') AS cut
FROM episodes
JOIN (SELECT recording_id, source_file FROM recordings) USING (recording_id)
WHERE goal_source = 'hindsight'
GROUP BY source_file, recording_id
ORDER BY source_file, recording_id
