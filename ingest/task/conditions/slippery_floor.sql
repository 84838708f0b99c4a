-- The floor under the robot is slippery: in the time in which the robot drives .2 m, up to this step,
-- the wheels turned more than the poses and the gyroscope moved. The label lasts about a second longer. A
-- patch that the robot crosses without slip leaves no evidence, so some patches are missed. Unlike the
-- outcome `wheel_slip`, the label needs no later step.
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
