-- severity: warning
-- advice: Take one kind of goal into a panel: where = "goal_source = 'logged'" in its mixture. Returns of the two are not comparable, and only the logged ones have successes.
-- doc: Tasks whose rows have goals of both kinds: ordered, and by hindsight.
SELECT
    task_hash,
    count(DISTINCT episode_id) FILTER (WHERE goal_source = 'logged') AS logged_episodes,
    count(DISTINCT episode_id) FILTER (WHERE goal_source = 'hindsight') AS hindsight_episodes
FROM episodes
JOIN (SELECT recording_id, format FROM recordings) USING (recording_id)
WHERE format <> 'twin'
GROUP BY task_hash
HAVING logged_episodes > 0 AND hindsight_episodes > 0
ORDER BY task_hash
