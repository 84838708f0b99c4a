-- severity: info
-- advice: Leave such rows out of strata, have people review them (restock label --review), or log a better sensor.
-- doc: Conditions of whose rows, labelled or uncertain, many are too near to call by their probability.
SELECT condition, uncertain, rows, uncertain / rows AS uncertain_share
FROM (
    SELECT
        condition,
        count(*) FILTER (WHERE list_contains(uncertain, condition)) AS uncertain,
        count(*) AS rows
    FROM (
        SELECT uncertain, unnest(list_distinct(list_concat(conditions, uncertain))) AS condition
        FROM transitions
        WHERE uncertain IS NOT NULL
    )
    GROUP BY condition
)
WHERE rows >= $min_rows AND uncertain / rows > $max_uncertain_share
ORDER BY uncertain_share DESC, condition
