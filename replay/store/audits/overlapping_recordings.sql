-- severity: info
-- advice: If one robot recorded both, the store has that time twice: remove one with `restock store remove STORE RECORDING`. If they are from several robots, tag them with `restock ingest RECORDING --tag robot=…`: [tags] in docs/ingest.md.
-- doc: Recordings of one robot (of one profile, if no tag names the robot) that cover the same log time as an earlier recording.
WITH beside AS (
    SELECT
        recording_id,
        source_file,
        robot,
        logged_start_time AS begins,
        logged_end_time AS ends,
        max(logged_end_time) OVER earlier AS until,
        arg_max(recording_id, logged_end_time) OVER earlier AS same_time_as,
        arg_max(source_file, logged_end_time) OVER earlier AS same_time_as_file
    FROM recordings
    WHERE transitions > 0
    WINDOW earlier AS (
        PARTITION BY robot, CASE WHEN robot IS NULL THEN profile END
        ORDER BY logged_start_time, recording_id
        ROWS BETWEEN UNBOUNDED PRECEDING AND 1 PRECEDING
    )
)
SELECT
    recording_id,
    source_file,
    same_time_as,
    same_time_as_file,
    robot,
    epoch(least(until, ends) - begins) AS both_s
FROM beside
WHERE until IS NOT NULL AND both_s >= $min_overlap_s
ORDER BY both_s DESC, recording_id
