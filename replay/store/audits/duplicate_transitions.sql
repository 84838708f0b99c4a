-- severity: error
-- advice: The same recording is in the store twice: ingest it again, which replaces its rows.
-- doc: Transition ids that occur more than once.
SELECT transition_id, count(*) AS copies, list(DISTINCT source_file) AS source_files
FROM transitions
GROUP BY transition_id
HAVING count(*) > 1
