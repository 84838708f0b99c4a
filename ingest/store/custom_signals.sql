-- Names of the profiles' own signals. Included in a view and in measured_custom_signals.sql.
SELECT DISTINCT unnest(CAST(json_extract_string(to_json(kept), '$.signals[*].name') AS VARCHAR[])) AS signal
FROM recordings AS kept
ORDER BY signal
