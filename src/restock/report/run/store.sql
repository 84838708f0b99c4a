-- What the report shows of the store that the run's panel came from.

-- name: logged
-- The conditions that logged episodes met: the nearest thing to deployment that there is. An
-- episode that met several counts for each; one that met none is nominal.
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
