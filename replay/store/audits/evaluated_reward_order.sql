-- severity: error
-- advice: The reward pays for something other than success. Let a bump end the episode ([task] bump_terminates = true), let it cost more than speed earns ([task.rewards] bump), or use a longer horizon (--discount, loss.discount); then ingest and train again. See docs/task.md.
-- needs: run.driven_episodes
-- doc: Conditions in which a driver with a significantly higher success earns a significantly lower return, in evaluations of the run.
FROM return_order('run.driven_episodes', $min_episodes, 0)
WHERE verdict = 'reversed'
