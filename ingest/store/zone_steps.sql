-- Steps per episode and zone, and the stamp of the first. From `transitions`. For the summary in a recording's
-- manifest; if another tool changed rows of a store, it is a view over all rows.
SELECT recording_id, episode_id, zone, min(stamp_ns) AS start_ns, count(*) AS steps
FROM transitions
GROUP BY recording_id, episode_id, zone
