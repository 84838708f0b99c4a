-- severity: info
-- advice: Record or collect more of it, or leave it out: a cell this thin says nothing of how a policy does there.
-- doc: Perturbation x condition cells of the twin with fewer rows than the minimum, empty ones included.
SELECT perturbation, condition, count(transition_id) AS rows, count(DISTINCT episode_id) AS episodes
FROM (SELECT DISTINCT perturbation FROM transitions WHERE perturbation IS NOT NULL)
CROSS JOIN (SELECT condition FROM conditions)
LEFT JOIN transitions USING (perturbation, condition)
GROUP BY perturbation, condition
HAVING count(transition_id) < $min_rows
ORDER BY rows, perturbation, condition
