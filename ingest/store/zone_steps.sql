-- Steps per episode and zone, and the stamp of the first. From `transitions`. Included in two statements:
-- the view that scans rows, and the summary in a recording's manifest.
SELECT recording_id, episode_id, zone, min(stamp_ns) AS start_ns, count(*) AS steps
FROM transitions
GROUP BY recording_id, episode_id, zone
