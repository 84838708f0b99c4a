-- severity: info
-- advice: Here the robot did not do what the row says: add an action, or leave out such rows with the mixture's `where`.
-- doc: Behaviour policies whose commands are often far from all discrete actions.
SELECT
    behaviour_policy,
    count(*) AS rows,
    avg((action_residual > $max_residual)::INTEGER) AS far_share
FROM transitions
GROUP BY behaviour_policy
HAVING avg((action_residual > $max_residual)::INTEGER) > $max_far_share
ORDER BY far_share DESC
