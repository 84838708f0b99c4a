-- severity: warning
-- advice: Look at that part of the robot, or at the site where the other robots changed alike; `restock drift` shows the weeks.
-- doc: Robots of which a signal, or how often a condition begins, changed against their own first weeks.
SELECT robot, site, part, signal, zone, period, scope, compared, change, change_low, change_high, size, q
FROM drift_by(sizes := false)
WHERE against = 'own reference' AND q <= $max_q AND size >= $min_size
ORDER BY part IN ('driving', 'conditions'), size DESC
