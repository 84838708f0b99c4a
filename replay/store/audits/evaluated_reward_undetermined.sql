-- severity: warning
-- advice: More episodes would tell: `restock eval RUN --policies agent,planner,operator --episodes 200`.
-- needs: run.driven_episodes
-- doc: Pairs of drivers of whom too few episodes are there to tell whether more success earns more, in evaluations of the run.
FROM undetermined_order('run.driven_episodes', $min_episodes, $same_success)
