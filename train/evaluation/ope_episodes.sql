-- Rows for off-policy evaluation: those whose IDs are in `wanted`. Contacts before and after a row
-- are looked up in all rows of its episode. A row's `bumped` is the contact before it, so the contact
-- of a step is in the next row. For the last row it is known if it terminated the episode. Contacts
-- before the first wanted row do not count.
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
), named AS (  -- an episode's condition is the most frequent one of its labelled rows; ties: the first
    SELECT episode_id,
           coalesce(mode(primary_condition ORDER BY step_index) FILTER (primary_condition <> 'nominal'), 'nominal') AS of_condition
    FROM whole
    GROUP BY episode_id
)
SELECT episode_id, of_condition, observation, action, reward, next_observation, terminated,
       action_probability, bumps, bumped_before
FROM whole JOIN wanted USING (transition_id) JOIN named USING (episode_id)
ORDER BY recording_id, episode_index, step_index
