-- severity: warning
-- advice: More episodes of each driver would decide; `restock eval RUN --policies agent,planner,operator` drives all of them on the same missions, which needs the fewest episodes, and `restock audit RUN --reward` compares them.
-- doc: Pairs of drivers with too few episodes to decide whether more success earns more.
FROM undetermined_order('driven_episodes', $min_episodes, $same_success)
