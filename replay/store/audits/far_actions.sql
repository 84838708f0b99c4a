-- severity: info
-- advice: What the robot did there is not what the row says: add an action, or leave such rows out with the mixture's `where`.
-- doc: Behaviour policies whose commands are often far from every discrete action.
SELECT
    behaviour_policy,
    count(*) AS rows,
    avg((action_residual > $max_residual)::INTEGER) AS far_share
FROM transitions
GROUP BY behaviour_policy
HAVING avg((action_residual > $max_residual)::INTEGER) > $max_far_share
ORDER BY far_share DESC
