-- severity: warning
-- advice: Check that part of the robot, or the site if its other robots changed in the same way; `restock coverage drift` shows the weeks.
-- doc: Robots with a signal, or the rate of a condition, that changed compared with their own first weeks.
SELECT robot, site, part, signal, zone, period, scope, compared, change, change_low, change_high, size, q
FROM drift_by()
WHERE against = 'own reference' AND q <= $max_q AND size >= $min_size
ORDER BY part IN ('driving', 'conditions'), size DESC
