-- severity: warning
-- advice: Use one kind of goal in a panel: where = "goal_source = 'logged'" in its mixture. Returns of the two kinds are not comparable, and only logged goals have successes.
-- doc: Tasks whose rows have goals of both kinds: recorded, and in hindsight.
SELECT
    task_hash,
    count(DISTINCT episode_id) FILTER (WHERE goal_source = 'logged') AS logged_episodes,
    count(DISTINCT episode_id) FILTER (WHERE goal_source = 'hindsight') AS hindsight_episodes
FROM episodes
GROUP BY task_hash
HAVING logged_episodes > 0 AND hindsight_episodes > 0
ORDER BY task_hash
