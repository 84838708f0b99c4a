-- An obstacle stands on the plan just ahead and does not move. The evidence: the driven plus the free
-- part of the plan end at the same place now and 1.6 s ago; nobody came nearer within 8 s; and a return
-- lies within a fifth of the robot's width of the plan's middle, unlike the corner of a rack that the
-- plan passes. A robot that has turned away from the plan sees less of the obstacle. In the first 1.6 s
-- of an episode there is no evidence that it does not move. A label needs clear evidence within the
-- last 1 s, and weak evidence at the step itself, so it bridges gaps.
-- Unknown if the plan is the path that was driven, as with goals in hindsight.
-- Weights: a logistic regression; `python benchmarks/labels.py --cache FOLDER --fit blocked_aisle`.
-- The weight of someone_m was raised by hand, on two logs, after it stopped counting edges and lost
-- beams.
-- timing: pre
-- priority: 40
-- uncertain: 0.2 to 0.8
-- let ahead_m:
least(plan_return_m, 2.5)
-- let driven_m:
CASE WHEN route_remaining_m > 0 THEN -route_remaining_m ELSE
    avg(wheel_speed_mps) OVER episode * (stamp_ns - first_value(stamp_ns) OVER episode) / 1e9
END
-- let at_m:
driven_m + ahead_m
-- let came_lately_m:
sum(came_nearer_m) OVER (episode ROWS BETWEEN {0.2 s} - 1 PRECEDING AND CURRENT ROW)
-- let came_m:
sum(greatest(came_lately_m - 2 * lidar_noise_m, 0)) OVER (episode ROWS BETWEEN {0.8 s} - 1 PRECEDING AND CURRENT ROW) / {0.2 s}
-- let moved_m:
least(abs(at_m - coalesce(lag(at_m, {1.6 s}) OVER episode, first_value(at_m) OVER episode)), 0.6)
-- let bend_rad:
least(abs(atan2(waypoint_near_y_m, waypoint_near_x_m)), 1.5)
-- let someone_m:
least(max(came_m) OVER (episode ROWS BETWEEN {8 s} PRECEDING AND CURRENT ROW), 1)
-- let aside_m:
greatest(least(plan_gap_m / body_width_m, 0.5) - 0.2, 0) * 0.5
-- let early:
greatest(1 - step_index / {1.6 s}, 0)
-- let odds:
CASE WHEN ahead_m < 1.45 THEN
    + 3.86
    - 7.46 * moved_m
    + 2.92 * bend_rad
    - 24 * someone_m
    - 35.69 * aside_m
    - 3.82 * early
ELSE -9 END
-- label:
odds > -2.9 AND max(odds) OVER (episode ROWS BETWEEN {1 s} PRECEDING AND CURRENT ROW) > 2.2
-- probability:
1 / (1 + exp(-greatest(least(odds, 30), -30)))
