-- severity: info
-- advice: Off-policy evaluation with importance weights needs the probability of each action; without it, the probability is estimated.
-- doc: Behaviour policies that did not log the probability of their actions.
SELECT behaviour_policy, count(*) AS rows
FROM transitions
WHERE action_probability IS NULL
GROUP BY behaviour_policy
ORDER BY rows DESC
