-- severity: info
-- advice: Leave such rows out of strata, let people review them (`restock review STORE`), or log a better sensor.
-- doc: Conditions with an uncertain probability in a large share of the rows that are labelled or uncertain.
WITH doubted AS (
    SELECT
        condition,
        count(*) AS uncertain,
        count(*) FILTER (WHERE NOT list_contains(coalesce(conditions, []), condition)) AS not_held
    FROM (
        SELECT conditions, unnest(list_distinct(uncertain)) AS condition
        FROM transitions
        WHERE len(uncertain) > 0
    )
    GROUP BY condition
), held AS (
    -- Without uncertain rows, nothing is read here.
    SELECT condition, count(*) AS rows
    FROM (SELECT unnest(conditions) AS condition FROM transitions WHERE uncertain IS NOT NULL)
    WHERE condition IN (SELECT condition FROM doubted)
    GROUP BY condition
)
SELECT condition, uncertain, rows, uncertain / rows AS uncertain_share
FROM (SELECT condition, uncertain, not_held + coalesce(held.rows, 0) AS rows FROM doubted LEFT JOIN held USING (condition))
WHERE rows >= $min_rows AND uncertain / rows > $max_uncertain_share
ORDER BY uncertain_share DESC, condition
