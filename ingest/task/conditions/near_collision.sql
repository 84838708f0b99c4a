-- At the next step something is nearer than `tight_clearance_m` of the robot's rewards (.15 m for a
-- robot that is half a metre wide), or the bumper is pressed. The smallest of many noisy lidar beams
-- reads short by about half its noise, and one reading is too noisy to decide, so the readings a step
-- before and after it count too. A step near the limit is labelled if a step within two of it is clear.
-- Weights: a logistic regression over development logs; `benchmarks/labels.py` measures the labels.
-- timing: post
-- priority: 20
-- uncertain: 0.2 to 0.8
-- let room_m:
least(clearance_m, tight_clearance_m + 0.2)
-- let after_m:
lead(room_m) OVER episode
-- let around_m:
least((room_m + coalesce(lead(room_m, 2) OVER episode, tight_clearance_m + 0.2)) / 2, after_m + 2 * lidar_noise_m)
-- let odds:
2.7 * (tight_clearance_m - 0.45 * lidar_noise_m - 0.53 * after_m - 0.47 * around_m) / lidar_noise_m
-- let bump:
coalesce(lead(bumped) OVER episode, false)
-- label:
bump
OR (odds > -0.8 AND max(odds) OVER (episode ROWS BETWEEN 2 PRECEDING AND 2 FOLLOWING) > 0)
-- probability:
CASE WHEN bump THEN 1 ELSE 1 / (1 + exp(-odds)) END
