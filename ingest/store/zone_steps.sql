-- Steps of each episode by zone, and when the first of them was. Over `transitions`. Part of two
-- statements: the view that scans, and the summary that a recording's manifest keeps.
SELECT recording_id, episode_id, zone, min(stamp_ns) AS start_ns, count(*) AS steps
FROM transitions
GROUP BY recording_id, episode_id, zone
