-- severity: error
-- advice: Observations, actions and rewards mean different things here: ingest the recordings of the older one again (`restock ingest`; labels can be made anew in place, rewards cannot), or choose one in the mixture's `where`.
-- doc: Rows made by more than one definition of the task.
SELECT task_hash, CAST(sum(transitions) AS BIGINT) AS rows, count(DISTINCT recording_id) AS recordings
FROM recordings
WHERE (SELECT count(DISTINCT task_hash) FROM recordings) > 1
GROUP BY task_hash
ORDER BY rows DESC
