-- severity: error
-- needs: panel
-- advice: Make the panel again; episodes must be wholly in or wholly held out.
-- doc: Episodes that are in the panel and held out at once.
SELECT episode_id, count(*) AS rows
FROM panel.rows
WHERE episode_id IN (SELECT episode_id FROM panel.held_out)
GROUP BY episode_id
