-- severity: warning
-- advice: More episodes would decide: `restock eval RUN --policies agent,planner,operator --episodes 200`.
-- needs: run.driven_episodes
-- doc: Pairs of drivers with too few episodes to decide whether more success earns more, in evaluations of the run.
FROM undetermined_order('run.driven_episodes', $min_episodes, $same_success)
