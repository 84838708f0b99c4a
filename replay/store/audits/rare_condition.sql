-- severity: error
-- advice: Record or ingest more of this condition; until then, cap its stratum or remove it from the mixture.
-- doc: Conditions that hold in too few rows or episodes to be learned from, including conditions that were never seen.
SELECT condition, rows_held, episodes_held
FROM coverage_by_condition
WHERE rows_held < $min_rows OR episodes_held < $min_episodes
ORDER BY rows_held, condition
