-- Someone within 2 m comes nearer, whatever the outcome: over the last .8 s, the approach that the lidar
-- saw, without the robot's own motion, adds up to more than .1 m beyond the noise of two ranges per
-- .2 s. The label lasts another second, as people do not vanish.
-- kind: exposure
-- timing: pre
-- let came_lately_m:
sum(came_nearer_m) OVER (episode ROWS BETWEEN {0.2 s} - 1 PRECEDING AND CURRENT ROW)
-- let came_m:
sum(greatest(came_lately_m - 2 * lidar_noise_m, 0)) OVER (episode ROWS BETWEEN {0.8 s} - 1 PRECEDING AND CURRENT ROW) / {0.2 s}
-- label:
max(came_m) OVER (episode ROWS BETWEEN {1 s} PRECEDING AND CURRENT ROW) > 0.1
