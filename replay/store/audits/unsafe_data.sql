-- severity: warning
-- advice: Leave these episodes out with the mixture's `where`, or keep them in a stratum of their own with a cap.
-- doc: Behaviour policies that bumped into things in too many of their steps.
SELECT
    behaviour_policy,
    count(*) AS rows,
    avg(bumped::INTEGER) AS bumped_share,
    count(DISTINCT episode_id) FILTER (bumped) AS episodes
FROM transitions
GROUP BY behaviour_policy
HAVING avg(bumped::INTEGER) > $max_bumped_share
ORDER BY bumped_share DESC
