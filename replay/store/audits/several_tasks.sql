-- severity: error
-- advice: Observations, actions and rewards have different meanings here: ingest the recordings of the older task again (`restock ingest`; labels can be computed again in place, rewards cannot), or choose one task in the mixture's `where`.
-- doc: Rows made with more than one definition of the task.
SELECT task_hash, CAST(sum(transitions) AS BIGINT) AS rows, count(DISTINCT recording_id) AS recordings
FROM recordings
WHERE (SELECT count(DISTINCT task_hash) FROM recordings) > 1
GROUP BY task_hash
ORDER BY rows DESC
