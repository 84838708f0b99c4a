-- A slippery patch is underfoot: up to now, without a look ahead, the wheels turned more than the poses
-- and the gyroscope moved, over the time in which the robot drives .2 m. It holds on for a second. Of a
-- patch that is crossed without slip there is no sign: this sees less than what lies on the floor, and
-- sooner than the outcome `wheel_slip`.
-- kind: exposure
-- timing: pre
-- let pose_noise_mps:
2 * localiser_noise_m / (({0.2 m} + 1) * control_period_s)
-- let over_mps:
coalesce((wheel_speed_mps + lag(wheel_speed_mps) OVER episode) / 2 - localised_speed_mps, 0)
-- let slip_mps:
abs(sum(over_mps) OVER (episode ROWS BETWEEN {0.2 m} PRECEDING AND CURRENT ROW)) / ({0.2 m} + 1)
+ 0.6 * body_width_m * abs(wheel_yaw_rate_radps - gyro_yaw_rate_radps)
+ 0.5 * abs(sum(localised_lateral_mps) OVER (episode ROWS BETWEEN {0.2 m} PRECEDING AND CURRENT ROW))
    / ({0.2 m} + 1)
-- label:
max(CASE WHEN step_index > 1 THEN slip_mps ELSE 0 END)
    OVER (episode ROWS BETWEEN {0.8 s} PRECEDING AND CURRENT ROW)
> greatest(slip_limit_mps + 0.01 + 0.8 * pose_noise_mps, 2.5 * pose_noise_mps)
