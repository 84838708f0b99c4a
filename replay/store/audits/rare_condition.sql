-- severity: error
-- advice: Record or ingest more of this condition; until then give its stratum a cap or drop it from the mixture.
-- doc: Conditions with too few rows or episodes to be learned from, those never seen included.
SELECT condition, rows, episodes, share
FROM coverage_by_condition
WHERE rows < $min_rows OR episodes < $min_episodes
ORDER BY rows, condition
