-- severity: warning
-- advice: Rows of one episode are alike: lower this stratum's share, or add episodes in other places.
-- doc: Conditions whose rows come from so few episodes that they are worth fewer still.
SELECT condition, rows, episodes, effective_episodes
FROM coverage_by_condition
WHERE rows > 0 AND effective_episodes < $min_effective_episodes
ORDER BY effective_episodes, condition
