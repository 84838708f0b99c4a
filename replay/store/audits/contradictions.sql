-- severity: warning
-- advice: Check the named topic, and follow the remedy in its row. The recording's rows are not repaired: until then, keep it out of mixtures (`restock store remove`).
-- doc: Recordings with a topic that contradicts the others: clocks, wheels, gyro, poses.
SELECT recording_id, source_file, found.topic, found.what, found.steps, found.cause, found.remedy
FROM (SELECT recording_id, source_file, unnest(findings) AS found FROM recordings)
WHERE NOT found.repaired
ORDER BY source_file, recording_id
