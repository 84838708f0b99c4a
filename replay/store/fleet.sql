-- Weeks and robots of a fleet: what was driven in which condition, and what happened, including cells never
-- seen. An episode counts for the week in which it began, by log time, so counts can be added up over weeks.

-- One row per robot, week and condition.
CREATE OR REPLACE VIEW coverage_by_week AS
WITH of_episode AS (
    SELECT
        episode_id,
        success,
        CAST(date_trunc('week', logged_start_time) AS DATE) AS week,
        period_h
    FROM episodes
    JOIN (
        SELECT
            recording_id,
            CAST(json_extract_string(task_json, '$.control_period_s') AS DOUBLE) / 3600 AS period_h
        FROM recordings
    ) USING (recording_id)
), seen AS (
    SELECT
        robot,
        week,
        condition,
        count(*) AS rows_held,
        count(*) FILTER (WHERE condition = primary_condition) AS primary_rows,
        sum(period_h) FILTER (WHERE condition = primary_condition) AS hours,
        count(DISTINCT episode_id) AS episodes_held,
        count(DISTINCT episode_id) FILTER (WHERE success IS NOT NULL) AS goal_episodes,
        count(DISTINCT episode_id) FILTER (WHERE success) AS successes
    FROM held_conditions
    JOIN of_episode USING (episode_id)
    GROUP BY robot, week, condition
), happened AS (
    SELECT
        robot,
        week,
        condition,
        count(*) AS events,
        count(*) FILTER (WHERE outcome = 'not recovered') AS not_recovered
    FROM events
    JOIN of_episode USING (episode_id)
    GROUP BY robot, week, condition
), cells AS (
    SELECT
        robot, week, condition, rows_held, episodes_held, primary_rows, hours, goal_episodes, successes,
        0 AS events, 0 AS not_recovered
    FROM seen
    UNION ALL
    SELECT robot, week, condition, 0, 0, 0, 0, 0, 0, events, not_recovered
    FROM happened
    UNION ALL
    SELECT robot, week, condition, 0, 0, 0, 0, 0, 0, 0, 0
    FROM (SELECT DISTINCT robot, week FROM seen)
    CROSS JOIN (
        SELECT condition FROM conditions
        UNION
        SELECT condition FROM seen
        UNION
        SELECT condition FROM happened
    )
)
SELECT
    robot,
    week,
    condition,
    CAST(sum(rows_held) AS BIGINT) AS rows_held,
    sum(rows_held) / sum(sum(primary_rows)) OVER (PARTITION BY robot, week) AS held_share,
    CAST(sum(episodes_held) AS BIGINT) AS episodes_held,
    CAST(sum(goal_episodes) AS BIGINT) AS goal_episodes,
    CAST(sum(successes) AS BIGINT) AS successes,
    sum(successes) / nullif(sum(goal_episodes), 0) AS success_share,
    CAST(sum(events) AS BIGINT) AS events,
    CAST(sum(not_recovered) AS BIGINT) AS not_recovered,
    sum(sum(hours)) OVER (PARTITION BY robot, week) AS hours,
    sum(events) / sum(sum(hours)) OVER (PARTITION BY robot, week) AS events_per_hour,
    CAST(sum(primary_rows) AS BIGINT) AS primary_rows,
    sum(primary_rows) / sum(sum(primary_rows)) OVER (PARTITION BY robot, week) AS primary_share
FROM cells
GROUP BY robot, week, condition
ORDER BY robot, week, condition;

-- One row per robot and condition.
CREATE OR REPLACE VIEW coverage_by_robot AS
SELECT
    robot,
    condition,
    CAST(sum(rows_held) AS BIGINT) AS rows_held,
    sum(rows_held) / sum(sum(primary_rows)) OVER (PARTITION BY robot) AS held_share,
    CAST(sum(episodes_held) AS BIGINT) AS episodes_held,
    CAST(sum(goal_episodes) AS BIGINT) AS goal_episodes,
    CAST(sum(successes) AS BIGINT) AS successes,
    sum(successes) / nullif(sum(goal_episodes), 0) AS success_share,
    CAST(sum(events) AS BIGINT) AS events,
    CAST(sum(not_recovered) AS BIGINT) AS not_recovered,
    sum(hours) AS hours,
    sum(events) / sum(hours) AS events_per_hour,
    count(*) AS weeks,
    min(week) AS first_week,
    max(week) AS last_week,
    CAST(sum(primary_rows) AS BIGINT) AS primary_rows,
    sum(primary_rows) / sum(sum(primary_rows)) OVER (PARTITION BY robot) AS primary_share
FROM coverage_by_week
GROUP BY robot, condition
ORDER BY robot, condition;
