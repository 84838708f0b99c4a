-- Discounted and undiscounted returns of a store's episodes, by driver (behaviour policies with their
-- versions), condition and outcome.

-- Complete episodes only: the return of an episode with missing steps is unknown.
CREATE OR REPLACE MACRO discounted_episodes(discount) AS TABLE
SELECT
    episodes.episode_id AS episode_id,
    NULL::VARCHAR AS mission,
    driver,
    drivers > 1 AS handed_over,
    kind AS condition,
    CASE
        WHEN ended_by = 'goal' AND NOT episodes.success THEN 'goal after a bump'
        ELSE coalesce(ended_by, 'time limit')
    END AS outcome,
    episodes.success AS success,
    steps,
    episodes.return AS return,
    discounted_return
FROM episodes
JOIN (
    SELECT
        episode_id,
        array_to_string(list_sort(list(driver)), ' + ') AS driver,
        count(*) AS drivers,
        min(first_step) AS first_step,
        sum(discounted_return) AS discounted_return
    FROM (
        SELECT
            episode_id,
            concat_ws(' ', behaviour_policy, behaviour_version) AS driver,
            min(step_index) AS first_step,
            sum(reward * pow(discount, step_index)) AS discounted_return
        FROM transitions
        GROUP BY episode_id, concat_ws(' ', behaviour_policy, behaviour_version)
    )
    GROUP BY episode_id
) USING (episode_id)
JOIN (SELECT episode_id, kind FROM episode_kinds(3)) USING (episode_id)
JOIN (
    SELECT DISTINCT
        task_hash,
        CAST(json_extract_string(task_json, '$.time_limit_steps') AS BIGINT) AS time_limit
    FROM recordings
) USING (task_hash)
WHERE first_step = 0 AND missing_steps = 0 AND (ended_by IS NOT NULL OR steps >= time_limit);

-- With the default discount of training.
CREATE OR REPLACE VIEW driven_episodes AS FROM discounted_episodes(0.99);

-- One row per condition, driver and outcome; outcome 'all' is all outcomes together.
CREATE OR REPLACE VIEW returns AS FROM returns_of('driven_episodes');
