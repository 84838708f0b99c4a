-- severity: warning
-- advice: Replaying only failures teaches what not to do: before boosting this condition, add episodes that handled it (for example an operator's).
-- doc: Conditions in which most episodes did not reach the goal.
SELECT condition, rows_held, episodes_held, success_share, behaviour_policies
FROM coverage_by_condition
WHERE success_share < $min_success_share AND episodes_held >= $min_episodes
ORDER BY success_share, condition
