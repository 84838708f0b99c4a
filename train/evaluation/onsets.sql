-- The observations of each episode: of one that failed, those of the $steps steps before the one
-- in which its first failure began; of others,
-- all ($safe_rows rows at most). `failure` is
--   bump: the bumper was pressed;
--   takeover: one of $people began to drive;
--   stuck: the robot stayed within $stuck_m until the episode ended without success, for $stuck_s at least.
WITH steps AS (
    SELECT
        episode_id,
        step_index,
        stamp_ns,
        bumped AND NOT lag(bumped, 1, true) OVER episode AS bumps,
        behaviour_policy IN (SELECT unnest($people)) AND NOT
            lag(behaviour_policy IN (SELECT unnest($people)), 1, true) OVER episode AS takes_over,
        sqrt((pose_x_m - last(pose_x_m) OVER whole) ** 2 + (pose_y_m - last(pose_y_m) OVER whole) ** 2) AS from_end_m
    FROM transitions
    SEMI JOIN wanted USING (episode_id)
    WINDOW episode AS (PARTITION BY episode_id ORDER BY step_index),
        whole AS (episode ROWS BETWEEN UNBOUNDED PRECEDING AND UNBOUNDED FOLLOWING)
), ends AS (
    SELECT
        episode_id,
        least(
            min(step_index) FILTER (bumps) - 1,
            CASE WHEN any_value(ended_by) = 'bump' THEN max(step_index) END
        ) AS bump,
        min(step_index) FILTER (takes_over) AS takeover,
        CASE WHEN NOT any_value(success) AND any_value(ended) <> 'terminated'
            AND max(stamp_ns) - coalesce(max(stamp_ns) FILTER (from_end_m >= $stuck_m), min(stamp_ns)) >= $stuck_s * 1e9
            THEN coalesce(max(step_index) FILTER (from_end_m >= $stuck_m), min(step_index)) + 1
        END AS stuck
    FROM steps
    JOIN (SELECT episode_id, success, ended, ended_by FROM episodes) USING (episode_id)
    GROUP BY episode_id
), onsets AS (
    SELECT
        episode_id,
        least(bump, takeover, stuck) AS onset,
        CASE onset WHEN bump THEN 'bump' WHEN takeover THEN 'takeover' WHEN stuck THEN 'stuck' END AS failure
    FROM ends
), safe AS (
    SELECT transition_id
    FROM transitions
    JOIN onsets USING (episode_id)
    JOIN (SELECT episode_id, success FROM episodes) USING (episode_id)
    WHERE onset IS NULL AND success IS DISTINCT FROM false
    ORDER BY hash(episode_id), step_index
    LIMIT $safe_rows
)
SELECT failure, list(observation ORDER BY step_index) AS observations
FROM transitions
JOIN onsets USING (episode_id)
WHERE step_index BETWEEN onset - $steps AND onset - 1
    OR transition_id IN (FROM safe)
GROUP BY episode_id, failure
ORDER BY hash(episode_id), episode_id
