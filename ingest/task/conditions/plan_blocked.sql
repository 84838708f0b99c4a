-- Something lies or stands on the plan within view (2.2 m), whether it stops the robot or the robot
-- finds a way round: at each step of the last .8 s a lidar return was within half the robot's width of
-- the plan, and nobody came nearer within 5 s. A person who stands still on the plan looks like a pallet.
-- kind: exposure
-- timing: pre
-- let came_lately_m:
sum(came_nearer_m) OVER (episode ROWS BETWEEN {0.2 s} - 1 PRECEDING AND CURRENT ROW)
-- let came_m:
sum(greatest(came_lately_m - 2 * lidar_noise_m, 0)) OVER (episode ROWS BETWEEN {0.8 s} - 1 PRECEDING AND CURRENT ROW) / {0.2 s}
-- label:
max(plan_return_m) OVER (episode ROWS BETWEEN {0.8 s} PRECEDING AND CURRENT ROW) < 2.3
AND max(came_m) OVER (episode ROWS BETWEEN {5 s} PRECEDING AND CURRENT ROW) < 0.06
AND step_index >= {0.8 s}
