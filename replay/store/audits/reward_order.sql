-- severity: error
-- advice: The reward pays for something else. Let a bump end the episode ([task] bump_terminates = true), let it cost more than haste earns ([task.rewards] bump), or look further ahead (--discount, loss.discount); then ingest again. docs/reward.md.
-- doc: Conditions in which a driver that surely succeeds more surely earns less.
FROM return_order('driven_episodes', $min_episodes, 0)
WHERE verdict = 'reversed'
