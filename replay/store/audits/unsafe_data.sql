-- severity: warning
-- advice: Leave these episodes out with the mixture's `where`, or keep them in a stratum of their own with a cap.
-- doc: Behaviour policies that bumped into things in too many of their steps.
SELECT
    behaviour_policy,
    count(*) AS rows,
    avg(bumps::INTEGER) AS bumped_share,
    count(DISTINCT episode_id) FILTER (bumps) AS episodes
FROM (
    SELECT
        behaviour_policy,
        episode_id,
        -- Pressed at the start of a step, or what ended the episode.
        bumped OR (terminated AND ended_by = 'bump') AS bumps
    FROM transitions
    JOIN (SELECT episode_id, ended_by FROM episodes) USING (episode_id)
)
GROUP BY behaviour_policy
HAVING avg(bumps::INTEGER) > $max_bumped_share
ORDER BY bumped_share DESC
