-- severity: info
-- advice: Add the tag with `restock ingest RECORDING --tag robot=…` (the recording is not read again), or let the profile take it from the path: [tags] in docs/ingest.md.
-- doc: Recordings without a robot, site, firmware, map or shift while others have one: they are missing from all counts by that tag.
WITH told AS (
    SELECT
        count(robot) > 0 AS robot,
        count(site) > 0 AS site,
        count(firmware) > 0 AS firmware,
        count(map) > 0 AS map,
        count(shift) > 0 AS shift
    FROM recordings
)
SELECT
    source_file,
    recording_id,
    concat_ws(
        ', ',
        CASE WHEN recordings.robot IS NULL AND told.robot THEN 'robot' END,
        CASE WHEN recordings.site IS NULL AND told.site THEN 'site' END,
        CASE WHEN recordings.firmware IS NULL AND told.firmware THEN 'firmware' END,
        CASE WHEN recordings.map IS NULL AND told.map THEN 'map' END,
        CASE WHEN recordings.shift IS NULL AND told.shift THEN 'shift' END
    ) AS untold
FROM recordings
CROSS JOIN told
WHERE untold <> ''
ORDER BY source_file, recording_id
