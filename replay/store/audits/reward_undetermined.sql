-- severity: warning
-- advice: More episodes of each driver would tell; `restock eval RUN --policies agent,planner,operator` drives all of them on the same missions, which needs fewest, and `restock audit RUN --reward` compares those.
-- doc: Pairs of drivers of whom too few episodes are there to tell whether more success earns more.
FROM undetermined_order('driven_episodes', $min_episodes, $same_success)
