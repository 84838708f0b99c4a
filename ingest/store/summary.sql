-- Summary tables of a recording, from its `transitions` and its manifest (`recordings`). The manifest stores
-- them, and summaries.sql adds them up over the store. Cells are counted as in views.sql, which scans the
-- rows: a test compares both. Tables that need only one episode at a time (measured_signals, flawed_rows,
-- zone_steps, condition_steps) have their own files and are computed some episodes at a time.
CREATE TEMP TABLE steps AS
SELECT
    *,
    row_number() OVER (PARTITION BY episode_id ORDER BY step_index) > 1
    AND behaviour_policy IS DISTINCT FROM lag(behaviour_policy) OVER (
        PARTITION BY episode_id ORDER BY step_index
    ) AS handover
FROM (
    SELECT
        recording_id, episode_id, episode_index, step_index, stamp_ns, action, reward, terminated, truncated,
        primary_condition, conditions, behaviour_policy, zone, bumped, goal_source, clearance_m, progress_m
    FROM transitions
)
JOIN (
    SELECT
        recording_id,
        CAST(json_extract_string(task_json, '$.rewards.goal') AS DOUBLE) AS goal_reward,
        json_extract_string(task_json, '$.goal') = 'route' AS has_goal
    FROM recordings
) USING (recording_id);

CREATE TEMP TABLE episode_rows AS
SELECT
    any_value(recording_id) AS recording_id,
    episode_id,
    any_value(episode_index) AS episode_index,
    min(stamp_ns) AS start_ns,
    max(stamp_ns) AS end_ns,
    count(*) AS steps,
    CAST(max(step_index) - min(step_index) + 1 - count(*) AS BIGINT) AS missing_steps,
    -- include: episode_columns.sql
FROM steps
GROUP BY episode_id
ORDER BY min(step_index), episode_index;

-- A row for each condition that holds at a step, or one row with the primary condition if none holds.
CREATE TEMP TABLE held AS
SELECT *, unnest(conditions) AS condition
FROM steps
UNION ALL
SELECT *, primary_condition
FROM steps
WHERE coalesce(len(conditions), 0) < 1;

-- An episode belongs to one recording, so numbers of distinct episodes can be added up over recordings.
CREATE TEMP TABLE cells AS
SELECT
    recording_id,
    condition,
    action,
    zone,
    behaviour_policy,
    count(*) AS rows_held,
    count(*) FILTER (condition = primary_condition) AS primary_rows,
    count(reward) AS rewards,
    coalesce(sum(CAST(reward AS DOUBLE)), 0) AS reward_sum,
    count(terminated) AS known_ends,
    count(*) FILTER (terminated) AS terminated,
    count(DISTINCT episode_id) AS episodes_held,
    count(DISTINCT episode_id) FILTER (success) AS successes,
    count(DISTINCT episode_id) FILTER (success IS NOT NULL) AS goal_episodes
FROM held
JOIN (SELECT episode_id, success FROM episode_rows) USING (episode_id)
GROUP BY recording_id, condition, action, zone, behaviour_policy
ORDER BY ALL;

CREATE TEMP TABLE condition_episodes AS
SELECT
    recording_id,
    condition,
    count(*) AS episodes_held,
    CAST(sum(n) AS BIGINT) AS rows_held,
    CAST(sum(n * n) AS BIGINT) AS squared_rows,
    count(*) FILTER (success) AS successes,
    count(success) AS goal_episodes,
    count(return) AS returns,
    coalesce(sum(return), 0) AS return_sum,
    CAST(sum(primary_n) AS BIGINT) AS primary_rows,
    count(*) FILTER (primary_n > 0) AS primary_episodes
FROM (
    SELECT
        recording_id,
        condition,
        episode_id,
        count(*) AS n,
        count(*) FILTER (condition = primary_condition) AS primary_n
    FROM held
    GROUP BY recording_id, condition, episode_id
)
JOIN (SELECT episode_id, success, return FROM episode_rows) USING (episode_id)
GROUP BY recording_id, condition
ORDER BY ALL;
