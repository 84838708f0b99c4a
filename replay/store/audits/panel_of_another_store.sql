-- severity: error
-- needs: panel
-- advice: Audit the panel with the store and version that it was made from (`STORE@VERSION`; the panel's `panel.json` names both), or mix the panel again from this store.
-- doc: Recordings of the panel with rows that are not in this store: the panel was made from another store, or from a version with more rows. Rows from a mixture's other stores do not count.
WITH drawn AS (
    SELECT recording_id, transition_id
    FROM panel.rows
    SEMI JOIN (SELECT name AS stratum FROM panel.strata WHERE source = 'logs') USING (stratum)
)
SELECT
    recording_id,
    count(*) AS missing_rows,
    any_value(recordings) AS panel_recordings
FROM drawn
ANTI JOIN transitions USING (transition_id)
CROSS JOIN (SELECT count(DISTINCT recording_id) AS recordings FROM drawn)
GROUP BY recording_id
ORDER BY recording_id
