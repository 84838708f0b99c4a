-- severity: info
-- advice: Off-policy evaluation by importance weights needs the probability of each action; without it, it must be estimated.
-- doc: Behaviour policies that did not log how probable their actions were.
SELECT behaviour_policy, count(*) AS rows
FROM transitions
WHERE action_probability IS NULL
GROUP BY behaviour_policy
ORDER BY rows DESC
