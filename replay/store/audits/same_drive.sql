-- severity: warning
-- advice: This drive, or `share` of it, was probably recorded twice (replayed, cut, or read with another profile): remove one of the two with `restock store remove STORE RECORDING`, or those steps count twice.
-- doc: Recordings with the same commands and wheel speeds as another one, at one constant shift of their clocks, whatever their profiles use as pose, goal and actions.
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
