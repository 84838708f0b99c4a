-- Something stands on the plan just ahead, and stays where it is: what has been driven of the plan and
-- what is free of it add up to the same place along it, now and 1.6 s before, and nobody came nearer
-- within 8 s. Where the plan bends the lidar sees less of what stands on it, and before its end more
-- is near. It takes clear evidence within 2 s, and holds on through gaps.
-- Weights: a logistic regression; `python benchmarks/labels.py --cache FOLDER --fit blocked_aisle`.
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
-- let came_m:
sum(greatest(came_nearer_m - 2 * lidar_noise_m, 0)) OVER (episode ROWS BETWEEN 3 PRECEDING AND CURRENT ROW)
-- let near_m:
greatest(least(1.45 - ahead_m, 0.5), 0)
-- let moved_m:
least(abs(at_m - coalesce(lag(at_m, 8) OVER episode, first_value(at_m) OVER episode)), 0.6)
-- let fan_m:
greatest(least(1.4 - clearance_ahead_m, 1.2), 0)
-- let bend_rad:
least(abs(atan2(waypoint_near_y_m, waypoint_near_x_m)), 1.5)
-- let someone_m:
least(max(came_m) OVER (episode ROWS BETWEEN 40 PRECEDING AND CURRENT ROW), 1)
-- let short_m:
1 - least(sqrt(pow(waypoint_near_x_m, 2) + pow(waypoint_near_y_m, 2)), 1)
-- let odds:
CASE WHEN near_m > 0 THEN
    + 0.25
    + 4.01 * near_m
    - 6.16 * moved_m
    + 1.92 * fan_m
    + 4.88 * bend_rad
    - 12.20 * someone_m
    - 8.45 * short_m
ELSE -9 END
-- label:
odds > -2.2 AND max(odds) OVER (episode ROWS BETWEEN 10 PRECEDING AND CURRENT ROW) > 2.0
-- probability:
1 / (1 + exp(-greatest(least(odds, 30), -30)))
