-- severity: error
-- advice: The reward pays for something else. Let a bump end the episode ([task] bump_terminates = true), let it cost more than haste earns ([task.rewards] bump), or look further ahead (--discount, loss.discount); then ingest and train again. docs/reward.md.
-- needs: run.driven_episodes
-- doc: Conditions in which a driver that surely succeeds more surely earns less, in evaluations of the run.
FROM return_order('run.driven_episodes', $min_episodes, 0)
WHERE verdict = 'reversed'
