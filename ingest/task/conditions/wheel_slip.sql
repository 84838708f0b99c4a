-- The wheels and the world disagree by more than .15 m/s and what the localiser's noise adds to it:
-- how far the wheels turned against how far the poses lie apart, over two control periods before and
-- two after; the turn by the wheels against the gyroscope; and the way sideways. A step near the
-- limit holds where one within two steps is clear. Known only after the fact, so it is `post`.
-- Weights: a logistic regression over development logs; `benchmarks/labels.py` measures what they give.
-- timing: post
-- priority: 30
-- uncertain: 0.2 to 0.8
-- let over_mps:
coalesce((wheel_speed_mps + lag(wheel_speed_mps) OVER episode) / 2 - localised_speed_mps, 0)
-- let turn_radps:
coalesce(abs(wheel_yaw_rate_radps - gyro_yaw_rate_radps), 0)
-- let slip_mps:
0.23 * abs(over_mps + coalesce(lead(over_mps) OVER episode, 0))
+ 0.27 * abs(coalesce(lead(over_mps) OVER episode, 0) + coalesce(lead(over_mps, 2) OVER episode, 0))
+ 0.23 * greatest(turn_radps, lead(turn_radps) OVER episode)
+ 0.12 * abs(coalesce(lead(localised_lateral_mps) OVER episode, 0)
    + coalesce(lead(localised_lateral_mps, 2) OVER episode, 0))
-- let odds:
0.58 * (slip_mps - 0.15 - 4 * localiser_noise_m) / localiser_noise_m
-- label:
odds > -0.6 AND max(odds) OVER (episode ROWS BETWEEN 2 PRECEDING AND 2 FOLLOWING) > 0.2
-- probability:
1 / (1 + exp(-odds))
