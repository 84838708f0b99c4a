-- severity: warning
-- advice: Replaying failures teaches what not to do: add episodes that got through (an operator's, say) before boosting this condition.
-- doc: Conditions most of whose episodes did not reach the goal.
SELECT condition, rows, episodes, success_share, behaviour_policies
FROM coverage_by_condition
WHERE success_share < $min_success_share AND episodes >= $min_episodes
ORDER BY success_share, condition
