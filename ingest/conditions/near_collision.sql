-- Something is, or is about to be, closer than a hand's breadth, or the bumper was pressed.
-- timing: post
-- priority: 20
coalesce(lead(clearance_m) OVER episode < 0.15 OR lead(bumped) OVER episode, false)
