-- severity: info
-- advice: In such rows the command differs from the row's action: add an action to the task, or leave the rows out with the mixture's `where`.
-- doc: Behaviour policies whose commands are often far from all discrete actions.
SELECT
    behaviour_policy,
    count(*) AS rows,
    avg((action_residual > $max_residual)::INTEGER) AS far_share
FROM transitions
GROUP BY behaviour_policy
HAVING avg((action_residual > $max_residual)::INTEGER) > $max_far_share
ORDER BY far_share DESC
