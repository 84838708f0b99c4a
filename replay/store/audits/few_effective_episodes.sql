-- severity: warning
-- advice: Rows of one episode are similar: lower this stratum's share, or add episodes from other places.
-- doc: Conditions that have the information of too few equally long episodes.
SELECT condition, rows_held, episodes_held, effective_episodes
FROM coverage_by_condition
WHERE rows_held > 0 AND effective_episodes < $min_effective_episodes
ORDER BY effective_episodes, condition
