-- The wheels and the world disagree: speed against localisation over .6 s, or yaw rate against
-- the gyroscope at either end of the step. Known only after the fact, so it is `post`.
-- timing: post
-- priority: 30
coalesce(
    abs(avg(wheel_speed_mps - localised_speed_mps)
        OVER (episode ROWS BETWEEN 1 PRECEDING AND 1 FOLLOWING)) > 0.22
    OR greatest(
        abs(wheel_yaw_rate_radps - gyro_yaw_rate_radps),
        abs(lead(wheel_yaw_rate_radps - gyro_yaw_rate_radps) OVER episode)) > 0.5,
    false)
