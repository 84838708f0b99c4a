-- severity: warning
-- advice: Look at the topic that is named, and do what its finding says; rows of such a recording are as recorded, so leave it out of mixtures until then (`restock store remove`).
-- doc: Recordings with a topic that contradicts the others: clocks, wheels, gyro, poses.
SELECT recording_id, source_file, found.topic, found.what, found.steps, found.cause, found.remedy
FROM (SELECT recording_id, source_file, unnest(findings) AS found FROM recordings)
WHERE NOT found.repaired
ORDER BY source_file, recording_id
