-- Someone comes nearer within 2 m, whatever comes of it: what the lidar saw come nearer over the last
-- .8 s, the robot's own motion taken off, adds up to .1 m beyond the noise of two ranges every .2 s. It
-- holds on for a second, as people do not vanish.
-- kind: exposure
-- timing: pre
-- let came_lately_m:
sum(came_nearer_m) OVER (episode ROWS BETWEEN {0.2 s} - 1 PRECEDING AND CURRENT ROW)
-- let came_m:
sum(greatest(came_lately_m - 2 * lidar_noise_m, 0)) OVER (episode ROWS BETWEEN {0.8 s} - 1 PRECEDING AND CURRENT ROW) / {0.2 s}
-- label:
max(came_m) OVER (episode ROWS BETWEEN {1 s} PRECEDING AND CURRENT ROW) > 0.1
