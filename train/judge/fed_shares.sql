-- What the critics of two runs were fed, by source and condition: shares of all rows drawn, plain and
-- after importance weights. `fed_a` and `fed_b` are the runs' sampled_episodes.
WITH fed AS (
    SELECT 'a' AS side, * FROM fed_a UNION ALL SELECT 'b', * FROM fed_b
), shares AS (
    SELECT
        side,
        source,
        condition,
        sum(drawn_rows) AS drawn,
        count(DISTINCT episode) AS episodes,
        sum(drawn_rows) / sum(sum(drawn_rows)) OVER (PARTITION BY side) AS share,
        sum(weight) / sum(sum(weight)) OVER (PARTITION BY side) AS effective_share
    FROM fed
    GROUP BY side, source, condition
)
SELECT
    source,
    condition,
    coalesce(sum(drawn) FILTER (side = 'a'), 0)::BIGINT AS drawn_a,
    coalesce(sum(drawn) FILTER (side = 'b'), 0)::BIGINT AS drawn_b,
    coalesce(sum(share) FILTER (side = 'a'), 0) AS share_a,
    coalesce(sum(share) FILTER (side = 'b'), 0) AS share_b,
    coalesce(sum(effective_share) FILTER (side = 'a'), 0) AS effective_share_a,
    coalesce(sum(effective_share) FILTER (side = 'b'), 0) AS effective_share_b,
    coalesce(sum(episodes) FILTER (side = 'a'), 0)::BIGINT AS episodes_a,
    coalesce(sum(episodes) FILTER (side = 'b'), 0)::BIGINT AS episodes_b
FROM shares
GROUP BY source, condition
ORDER BY source, condition
