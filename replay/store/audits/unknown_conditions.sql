-- severity: warning
-- advice: Nothing was measured that these conditions need: record a scan, or leave them out of the profile and ask for no share of them. Rows of an older Restock say that they never hold: ingest those again.
-- doc: Conditions and exposures that the rows of a recording do not tell, such as what needs a lidar on a robot without one.
SELECT condition, kind, because, signals, count(*) AS recordings, sum(transitions) AS rows
FROM unknown_conditions
GROUP BY condition, kind, because, signals
UNION ALL
SELECT 'every one that names clearance', 'outcome', 'no lidar, and an older Restock took every way for free', [], count(*), sum(transitions)
FROM (SELECT transitions, unnest(stand_ins) AS stand_in FROM recordings WHERE unknown_conditions IS NULL)
WHERE stand_in.input = 'scan'
HAVING count(*) > 0
ORDER BY kind DESC, condition
