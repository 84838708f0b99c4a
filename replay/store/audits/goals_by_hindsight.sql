-- severity: info
-- advice: Their successes are counted nowhere. Returns and actions can be learned from; what they earned says little of who drove, as each drove to where it was sent and the goal came after. Record the goal topic where there is one.
-- doc: Recordings whose goals are where the robot got to, as none were ordered: every mission arrives, by construction.
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
