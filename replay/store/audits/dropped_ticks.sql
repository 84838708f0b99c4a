-- severity: warning
-- advice: `FROM drops` lists the reasons; a topic that comes too rarely, or a maximum age that is too strict, removes data.
-- doc: Recordings that lost too many ticks of the control clock, for example to stale topics or gaps.
SELECT recording_id, source_file, sum(count) AS dropped, any_value(ticks) AS ticks
FROM drops
JOIN (SELECT recording_id, ticks FROM recordings) USING (recording_id)
GROUP BY recording_id, source_file
HAVING sum(count) > $max_dropped_share * any_value(ticks)
ORDER BY dropped DESC
