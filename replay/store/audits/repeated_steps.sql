-- severity: error
-- advice: A bag and a part of it, or a copy cut otherwise, were both ingested: take one of the two recordings out, or these steps weigh twice and may be trained on and held out at once.
-- doc: Recordings that hold the same steps as another one: equal stamp, action and observation under another id.
WITH steps AS (
    SELECT recording_id, source_file, stamp_ns, action, hash(observation) AS seen
    FROM transitions
)
SELECT
    one.recording_id,
    any_value(one.source_file) AS source_file,
    other.recording_id AS same_as,
    any_value(other.source_file) AS same_as_file,
    count(*) AS rows
FROM steps AS one
JOIN steps AS other USING (stamp_ns, action, seen)
WHERE one.recording_id < other.recording_id
GROUP BY one.recording_id, other.recording_id
ORDER BY rows DESC, one.recording_id, same_as
