-- Rows for off-policy evaluation: those whose ids are in `wanted`. What happens before and after a row
-- in its episode is of all its rows from the first wanted one on. A contact of the last row is known
-- where it terminated the episode, and one that the first row tells of was before it.
WITH whole AS (
    SELECT *,
           coalesce(lead(bumped) OVER episode, terminated AND ended_by = 'bump') AS bumps,
           coalesce(bool_or(bumped AND step_index > first_step) OVER episode_so_far, false) AS bumped_before
    FROM transitions
    JOIN (SELECT episode_id, ended_by FROM episodes) USING (episode_id)
    JOIN (
        SELECT episode_id, min(step_index) AS first_step
        FROM transitions JOIN wanted USING (transition_id)
        GROUP BY episode_id
    ) USING (episode_id)
    WINDOW episode AS (PARTITION BY episode_id ORDER BY step_index),
           episode_so_far AS (episode ROWS BETWEEN UNBOUNDED PRECEDING AND CURRENT ROW)
), named AS (  -- an episode is of the condition that most of its labelled rows have, of equals the first
    SELECT episode_id,
           coalesce(mode(primary_condition ORDER BY step_index) FILTER (primary_condition <> 'nominal'), 'nominal') AS of_condition
    FROM whole
    GROUP BY episode_id
)
SELECT episode_id, of_condition, observation, action, reward, next_observation, terminated,
       action_probability, bumps, bumped_before
FROM whole JOIN wanted USING (transition_id) JOIN named USING (episode_id)
ORDER BY recording_id, episode_index, step_index
