-- Something is about to be closer than a hand's breadth, or the bumper to be pressed. (.14 m, for
-- the smallest of many noisy lidar beams reads short of the true .15 m.)
-- timing: post
-- priority: 20
coalesce(lead(clearance_m) OVER episode < 0.14 OR lead(bumped) OVER episode, false)
