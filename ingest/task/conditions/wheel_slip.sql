-- Wheel and ground motion differ by more than the robot's `slip_limit_mps` (.15 m/s, or less in
-- proportion if its fastest action is below 1 m/s) plus what the localiser's noise adds, and by more
-- than that noise causes alone. Three differences count: the wheels' distance against that of the poses,
-- in the time in which the robot drives .2 m and in the same time after it; the turn by the wheels
-- against the gyroscope; and the sideways motion. A step near the limit is labelled if a step within
-- two of it is clear. The label looks at later steps, so its timing is `post`.
-- Weights: a logistic regression over development logs; `benchmarks/labels.py` measures the labels.
-- timing: post
-- priority: 30
-- uncertain: 0.2 to 0.8
-- let pose_noise_mps:
2 * localiser_noise_m / (({0.2 m} + 1) * control_period_s)
-- let over_mps:
coalesce((wheel_speed_mps + lag(wheel_speed_mps) OVER episode) / 2 - localised_speed_mps, 0)
-- let now_mps:
sum(over_mps) OVER (episode ROWS BETWEEN CURRENT ROW AND {0.2 m} FOLLOWING) / ({0.2 m} + 1)
-- let then_mps:
coalesce(sum(over_mps) OVER (episode ROWS BETWEEN {0.2 m} FOLLOWING AND {0.4 m} FOLLOWING), 0)
    / ({0.4 m} - {0.2 m} + 1)
-- let sideways_mps:
coalesce(
    sum(localised_lateral_mps) OVER (episode ROWS BETWEEN {0.2 m} FOLLOWING AND {0.4 m} FOLLOWING),
    0)
    / ({0.4 m} - {0.2 m} + 1)
-- let turn_radps:
coalesce(abs(wheel_yaw_rate_radps - gyro_yaw_rate_radps), 0)
-- let slip_mps:
0.46 * abs(now_mps) + 0.54 * abs(then_mps) + 0.24 * abs(sideways_mps)
+ 0.46 * body_width_m * greatest(turn_radps, lead(turn_radps) OVER episode)
-- let limit_mps:
greatest(slip_limit_mps + 0.8 * pose_noise_mps, 2 * pose_noise_mps)
-- let odds:
2.9 * (slip_mps - limit_mps) / pose_noise_mps
-- label:
odds > -0.6 AND max(odds) OVER (episode ROWS BETWEEN 2 PRECEDING AND 2 FOLLOWING) > 0.2
-- probability:
1 / (1 + exp(-odds))
