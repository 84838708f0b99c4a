-- The query of a run's report on the store that the run's panel was mixed from.

-- name: logged
-- Logged episodes by condition, the best available estimate of deployment. An episode with several
-- conditions counts for each of them; an episode without any counts as nominal.
WITH met AS (
    SELECT episode_id, list_distinct(flatten(list(conditions))) AS met FROM transitions GROUP BY ALL
), each AS (
    SELECT episode_id, unnest(CASE WHEN len(met) = 0 THEN ['nominal'] ELSE met END) AS condition
    FROM met
)
SELECT condition, count(*) AS episodes, count(*) / sum(count(*)) OVER () AS share
FROM each
GROUP BY condition
ORDER BY episodes DESC, condition;
