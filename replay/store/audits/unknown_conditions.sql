-- severity: warning
-- advice: A signal that these conditions need was not recorded: record a scan, or remove them from the profile and give them no share.
-- doc: Conditions and exposures that are unknown in the rows of a recording, for example those that need a lidar on a robot without one.
SELECT condition, kind, because, signals, count(*) AS recordings, sum(transitions) AS rows
FROM unknown_conditions
GROUP BY condition, kind, because, signals
ORDER BY kind DESC, condition
