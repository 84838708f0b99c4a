-- severity: info
-- advice: Record or collect more of these cells, or do not use them: so few rows say nothing about a policy there.
-- doc: Perturbation x condition cells of the twin with fewer rows than the minimum, including empty cells.
SELECT perturbation, condition, coalesce(rows, 0) AS rows, coalesce(episodes, 0) AS episodes
FROM (SELECT DISTINCT perturbation FROM transitions WHERE perturbation IS NOT NULL)
CROSS JOIN (SELECT condition FROM conditions)
LEFT JOIN (
    SELECT perturbation, condition, count(*) AS rows, count(DISTINCT episode_id) AS episodes
    FROM held_conditions
    WHERE perturbation IS NOT NULL
    GROUP BY perturbation, condition
) USING (perturbation, condition)
WHERE coalesce(rows, 0) < $min_rows
ORDER BY rows, perturbation, condition
