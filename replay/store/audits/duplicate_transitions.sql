-- severity: error
-- advice: The same recording is in the store twice: ingest it again, which replaces its rows.
-- doc: Transition ids that occur more than once.
WITH several AS (
    SELECT transition_id FROM transitions GROUP BY transition_id HAVING count(*) > 1
)
SELECT transition_id, count(*) AS copies, list(DISTINCT source_file) AS source_files
FROM transitions
SEMI JOIN several USING (transition_id)
GROUP BY transition_id
ORDER BY transition_id
