-- severity: warning
-- advice: More episodes of each driver would tell; `restock eval RUN --policies agent,planner,operator` drives all of them on the same missions, which needs fewest, and `restock audit RUN --reward` compares those.
-- doc: Pairs of drivers of whom too few episodes are there to tell whether more success earns more.
WITH pairs AS (FROM return_order('driven_episodes', $min_episodes, $same_success))
SELECT condition, driver, other, why, episodes, other_episodes, more_success, more_return
FROM pairs
WHERE verdict = 'undetermined'
UNION ALL
SELECT NULL, NULL, NULL, 'no condition in which two drivers had a goal', 0, 0, NULL, NULL
WHERE NOT EXISTS (FROM pairs)
