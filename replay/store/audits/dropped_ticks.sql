-- severity: warning
-- advice: `FROM drops` says why; a topic that comes too seldom, or a maximum age that is too strict, takes data away.
-- doc: Recordings that lost too many ticks of the control clock to staleness, gaps and the like.
SELECT recording_id, source_file, sum(count) AS dropped, any_value(ticks) AS ticks
FROM drops
JOIN (SELECT recording_id, ticks FROM recordings) USING (recording_id)
GROUP BY recording_id, source_file
HAVING sum(count) > $max_dropped_share * any_value(ticks)
ORDER BY dropped DESC
