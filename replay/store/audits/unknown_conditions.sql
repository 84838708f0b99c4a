-- severity: warning
-- advice: A signal that these conditions need was not recorded: record a scan, or remove them from the profile and give them no share. Rows from an older Restock say that they never hold: ingest those recordings again.
-- doc: Conditions and exposures that are unknown in the rows of a recording, for example those that need a lidar on a robot without one.
SELECT condition, kind, because, signals, count(*) AS recordings, sum(transitions) AS rows
FROM unknown_conditions
GROUP BY condition, kind, because, signals
UNION ALL
SELECT 'every one that names clearance', 'outcome', 'no lidar, and an older Restock took every way for free', [], count(*), sum(transitions)
FROM (SELECT transitions, unnest(stand_ins) AS stand_in FROM recordings WHERE unknown_conditions IS NULL)
WHERE stand_in.input = 'scan'
HAVING count(*) > 0
ORDER BY kind DESC, condition
