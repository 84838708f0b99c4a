-- severity: warning
-- advice: More episodes would tell: `restock eval RUN --policies agent,planner,operator --episodes 200`.
-- needs: run.driven_episodes
-- doc: Pairs of drivers of whom too few episodes are there to tell whether more success earns more, in evaluations of the run.
WITH pairs AS (FROM return_order('run.driven_episodes', $min_episodes, $same_success))
SELECT condition, driver, other, why, episodes, other_episodes, more_success, more_return
FROM pairs
WHERE verdict = 'undetermined'
UNION ALL
SELECT NULL, NULL, NULL, 'no condition in which two drivers had a goal', 0, 0, NULL, NULL
WHERE NOT EXISTS (FROM pairs)
