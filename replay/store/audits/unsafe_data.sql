-- severity: warning
-- advice: Leave out these episodes with the mixture's `where`, or keep them in a stratum of their own with a cap.
-- doc: Behaviour policies with a bump in too many of their steps.
WITH bumps AS (
    -- Steps that start with the bumper pressed, and bumps that ended an episode.
    SELECT behaviour_policy, count(*) AS bumped, count(DISTINCT episode_id) AS episodes
    FROM (
        SELECT behaviour_policy, episode_id, bumped
        FROM transitions
        WHERE bumped OR terminated
    )
    JOIN (SELECT episode_id, ended_by FROM episodes) USING (episode_id)
    WHERE bumped OR ended_by = 'bump'
    GROUP BY behaviour_policy
), driven AS (
    SELECT behaviour_policy, CAST(sum(rows) AS BIGINT) AS rows
    FROM recording_cells
    GROUP BY behaviour_policy
)
SELECT behaviour_policy, rows, bumped / rows AS bumped_share, episodes
FROM driven
JOIN bumps USING (behaviour_policy)
WHERE bumped / rows > $max_bumped_share
ORDER BY bumped_share DESC
