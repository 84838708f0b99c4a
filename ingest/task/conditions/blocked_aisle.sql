-- Something stands in the way toward the next waypoint, and stays where it is. What the lidar sees
-- ahead is put on the map by the pose: a pallet lies where it lay .6, 1 and 3 s before; a person or a
-- forklift has moved, came nearer than the robot drove, or is suddenly very near. Where the plan bends
-- the lidar looks past the way. It takes clear evidence within 2 s, and then holds through gaps of .4 s.
-- Weights: a logistic regression over development logs; `benchmarks/labels.py` measures what they give.
-- timing: pre
-- priority: 40
-- uncertain: 0.2 to 0.8
-- let ahead_m:
least(clearance_ahead_m, 4)
-- let bend_rad:
abs(atan2(waypoint_near_y_m, waypoint_near_x_m))
-- let at_x_m:
pose_x_m + (ahead_m + 0.35) * cos(pose_yaw_rad + atan2(waypoint_near_y_m, waypoint_near_x_m))
-- let at_y_m:
pose_y_m + (ahead_m + 0.35) * sin(pose_yaw_rad + atan2(waypoint_near_y_m, waypoint_near_x_m))
-- let moved_3_m:
coalesce(sqrt(pow(at_x_m - lag(at_x_m, 3) OVER episode, 2) + pow(at_y_m - lag(at_y_m, 3) OVER episode, 2)), 1)
-- let moved_5_m:
coalesce(sqrt(pow(at_x_m - lag(at_x_m, 5) OVER episode, 2) + pow(at_y_m - lag(at_y_m, 5) OVER episode, 2)), 1)
-- let moved_10_m:
coalesce(sqrt(pow(at_x_m - lag(at_x_m, 10) OVER episode, 2) + pow(at_y_m - lag(at_y_m, 10) OVER episode, 2)), 1)
-- let moved_15_m:
coalesce(sqrt(pow(at_x_m - lag(at_x_m, 15) OVER episode, 2) + pow(at_y_m - lag(at_y_m, 15) OVER episode, 2)), 1)
-- let driven_3_m:
sqrt(pow(pose_x_m - lag(pose_x_m, 3) OVER episode, 2) + pow(pose_y_m - lag(pose_y_m, 3) OVER episode, 2))
* sign(sum(wheel_speed_mps) OVER (episode ROWS BETWEEN 3 PRECEDING AND CURRENT ROW))
-- let came_m:
CASE WHEN ahead_m < 1.5
    THEN greatest(least(coalesce(lag(ahead_m, 3) OVER episode - ahead_m - driven_3_m, 0), 1), 0)
    ELSE 0 END
-- let near:
greatest(least(1.4 - ahead_m, 0.6), 0)
-- let standing_share:
sum(CASE WHEN abs(wheel_speed_mps) < 0.05 THEN 1 ELSE 0 END)
    OVER (episode ROWS BETWEEN 10 PRECEDING AND CURRENT ROW) / 11
-- let near_steps:
sum(CASE WHEN ahead_m < 1.15 THEN 1 ELSE 0 END) OVER (episode ROWS BETWEEN 25 PRECEDING AND CURRENT ROW)
-- let odds:
CASE WHEN min(ahead_m) OVER (episode ROWS BETWEEN 2 PRECEDING AND CURRENT ROW) < 1.3 THEN
    5.6 * near
    + CASE WHEN ahead_m < 1.1 AND moved_5_m < 0.35 AND moved_10_m < 0.4 THEN 1.7 ELSE 0 END
    + CASE WHEN moved_3_m < 0.2 THEN 2.3 * near ELSE 0 END
    + 6.6 * least(bend_rad, 1.5) * near
    - 5.9 * standing_share * near
    - 7.6 * (1 - sqrt(pow(waypoint_near_x_m, 2) + pow(waypoint_near_y_m, 2)))
    - 4.9 * least(clearance_m, 1)
    - 2.3 * least(moved_15_m, 1)
    - 1.4 * max(came_m) OVER (episode ROWS BETWEEN 25 PRECEDING AND CURRENT ROW)
    - 125 * greatest(0.3 - ahead_m, 0) * (1 - least(near_steps / 10, 1))
    - 0.07
ELSE -9 END
-- label:
max(odds) OVER (episode ROWS BETWEEN 2 PRECEDING AND CURRENT ROW) > -0.85
AND max(odds) OVER (episode ROWS BETWEEN 10 PRECEDING AND CURRENT ROW) > 1.4
-- probability:
1 / (1 + exp(-greatest(least(odds, 30), -30)))
