-- severity: error
-- needs: panel
-- advice: Make the panel again after `duplicate_transitions` and `repeated_steps` pass; held-out data must share nothing with the training data.
-- doc: Data that is both in the panel and held out: an episode; a recording, robot or site, if whole ones are held out; an episode that ends after the first held-out one, if the latest are held out; steps up to the end of an episode, if ends are held out; or the same step under another id.
WITH copies AS (
    FROM same_steps()
), panel_steps AS (
    SELECT DISTINCT step, episode_id
    FROM copies
    JOIN panel.rows USING (transition_id)
), held AS (
    SELECT DISTINCT step
    FROM copies
    SEMI JOIN panel.evaluation_split USING (transition_id)
), ends AS (
    SELECT min(ended_ns) AS first_ns
    FROM (SELECT max(logged_ns) AS ended_ns FROM panel.evaluation_split GROUP BY episode_id)
)
SELECT 'the same episode' AS leak, episode_id, count(*) AS rows
FROM panel.rows
SEMI JOIN (FROM panel.evaluation_split WHERE split_by <> 'within_episode') USING (episode_id)
GROUP BY episode_id
UNION ALL
SELECT 'later in an episode whose end is held out', episode_id, count(*)
FROM panel.rows
JOIN (
    SELECT episode_id, min(step_index) AS first_held
    FROM panel.evaluation_split
    WHERE split_by = 'within_episode'
    GROUP BY episode_id
) USING (episode_id)
WHERE step_index + horizon >= first_held
GROUP BY episode_id
UNION ALL
SELECT 'a recording that is held out', episode_id, count(*)
FROM panel.rows
SEMI JOIN (FROM panel.evaluation_split WHERE split_by = 'recording') USING (recording_id)
GROUP BY episode_id
UNION ALL
SELECT 'a robot that is held out', episode_id, count(*)
FROM panel.rows
SEMI JOIN (FROM panel.evaluation_split WHERE split_by = 'robot') USING (robot)
GROUP BY episode_id
UNION ALL
SELECT 'a site that is held out', episode_id, count(*)
FROM panel.rows
SEMI JOIN (FROM panel.evaluation_split WHERE split_by = 'site') USING (site)
GROUP BY episode_id
UNION ALL
SELECT 'later than what is held out', episode_id, count(*)
FROM panel.rows
WHERE 'time' IN (SELECT split_by FROM panel.evaluation_split)
GROUP BY episode_id
HAVING max(logged_ns) > (SELECT first_ns FROM ends)
UNION ALL
SELECT 'the same step under another id', episode_id, count(*)
FROM panel_steps
SEMI JOIN held USING (step)
GROUP BY episode_id
ORDER BY leak, episode_id
