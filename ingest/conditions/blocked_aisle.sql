-- Something has stood in the way toward the next waypoint for .6 s.
-- timing: pre
-- priority: 40
max(clearance_ahead_m) OVER (episode ROWS BETWEEN 2 PRECEDING AND CURRENT ROW) < 1.0
