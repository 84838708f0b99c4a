-- severity: error
-- advice: A bag and a part of it, a differently cut copy, or the same drive recorded twice were both ingested: remove one of the two with `restock store remove STORE RECORDING`, or these steps count twice.
-- doc: Recordings that contain the same steps as another one: equal action, observation and pose, at one constant shift of their clocks (`repeated_rows`).
SELECT
    repeated.same_as AS recording_id,
    any_value(one.source_file) AS source_file,
    repeated.recording_id AS same_as,
    any_value(other.source_file) AS same_as_file,
    count(*) AS rows,
    count(*) / least(any_value(one.transitions), any_value(other.transitions)) AS share,
    any_value(shift_ns) / 1e9 AS later_s
FROM repeated_rows($min_rows) AS repeated
JOIN recordings AS one
    ON one.recording_id = repeated.same_as
JOIN recordings AS other
    ON other.recording_id = repeated.recording_id
GROUP BY repeated.same_as, repeated.recording_id
ORDER BY rows DESC, repeated.same_as, repeated.recording_id
