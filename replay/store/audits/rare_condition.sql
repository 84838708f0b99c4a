-- severity: error
-- advice: Record or ingest more of this condition; until then give its stratum a cap or drop it from the mixture.
-- doc: Conditions that hold in too few rows or episodes to be learned from, those never seen included.
SELECT condition, rows_held, episodes_held
FROM coverage_by_condition
WHERE rows_held < $min_rows OR episodes_held < $min_episodes
ORDER BY rows_held, condition
