-- The queries of the page on a store's coverage, each named by the comment before it.

-- name: shelves
SELECT condition, rows_held, held_share, episodes_held, effective_episodes, success_share,
       recordings, zones, behaviour_policies, primary_rows, primary_share,
       uncertain_recordings
FROM coverage_by_condition;

-- name: weeks
-- Rows of each condition in each week, over all robots. primary_rows counts each row once, by
-- priority. Hours are those of all robots in the week, whether or not they saw the condition.
WITH driven AS (
    SELECT week, sum(hours) AS hours
    FROM (SELECT DISTINCT robot, week, hours FROM coverage_by_week)
    GROUP BY week
)
SELECT seen.week, condition, any_value(driven.hours) AS hours,
       CAST(sum(primary_rows) AS BIGINT) AS primary_rows,
       CAST(sum(rows_held) AS BIGINT) AS rows_held, CAST(sum(events) AS BIGINT) AS events,
       CAST(sum(successes) AS BIGINT) AS successes,
       CAST(sum(goal_episodes) AS BIGINT) AS goal_episodes
FROM coverage_by_week AS seen JOIN driven ON seen.week IS NOT DISTINCT FROM driven.week
GROUP BY seen.week, condition
ORDER BY seen.week, condition;

-- name: robots
-- Hours are the robot's over all conditions: they are the same in each of its rows.
SELECT coalesce(robot, 'untagged') AS robot, condition, rows_held, held_share, hours
FROM coverage_by_robot
WHERE rows_held > 0
ORDER BY robot, condition;

-- name: bounds
SELECT min(pose_x_m) AS x0, min(pose_y_m) AS y0, max(pose_x_m) AS x1, max(pose_y_m) AS y1
FROM transitions;

-- name: visited
SELECT floor(pose_x_m / $cell_m) * $cell_m AS x_m,
       floor(pose_y_m / $cell_m) * $cell_m AS y_m,
       count(*) AS rows
FROM transitions
WHERE pose_x_m IS NOT NULL
GROUP BY ALL
ORDER BY ALL;

-- name: rare
SELECT pose_x_m AS x_m, pose_y_m AS y_m, condition
FROM held_conditions
WHERE condition <> 'nominal' AND pose_x_m IS NOT NULL
ORDER BY hash(transition_id), condition
LIMIT $most;

-- name: totals
SELECT count(*) AS rows, count(DISTINCT episode_id) AS episodes,
       count(DISTINCT recording_id) AS recordings
FROM transitions;
