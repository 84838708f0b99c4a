-- severity: error
-- advice: The reward pays for something other than success. Let a bump end the episode ([task] bump_terminates = true), let it cost more than speed earns ([task.rewards] bump), or use a longer horizon (--discount, loss.discount); then ingest again. See docs/task.md.
-- doc: Conditions in which a driver with a significantly higher success earns a significantly lower return.
FROM return_order('driven_episodes', $min_episodes, 0)
WHERE verdict = 'reversed'
