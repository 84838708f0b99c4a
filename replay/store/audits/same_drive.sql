-- severity: warning
-- advice: One drive was likely recorded twice (replayed, or by another profile): take one of the two recordings out, or its steps weigh twice.
-- doc: Recordings whose commands and wheel speeds are those of another one at one constant shift of their clocks, whatever their profiles take for the pose, the goal and the actions.
SELECT
    one.recording_id,
    file.source_file,
    same_as,
    other_file.source_file AS same_as_file,
    rows,
    share,
    later_s
FROM same_drives AS one
LEFT JOIN recordings AS file ON file.recording_id = one.recording_id
LEFT JOIN recordings AS other_file ON other_file.recording_id = same_as
WHERE rows >= $min_rows AND share >= $min_share
ORDER BY rows DESC, one.recording_id, same_as
