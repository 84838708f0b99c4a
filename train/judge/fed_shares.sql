-- What the critics of two runs were fed, by source and condition: shares of all rows drawn, plain and
-- after importance weights. `fed_a` and `fed_b` are the runs' sampled_episodes.
WITH of_a AS (
    SELECT
        source,
        condition,
        sum(drawn_rows) AS drawn,
        count(DISTINCT episode) AS episodes,
        sum(drawn_rows) / sum(sum(drawn_rows)) OVER () AS share,
        sum(weight) / sum(sum(weight)) OVER () AS effective_share
    FROM fed_a
    GROUP BY source, condition
), of_b AS (
    SELECT
        source,
        condition,
        sum(drawn_rows) AS drawn,
        count(DISTINCT episode) AS episodes,
        sum(drawn_rows) / sum(sum(drawn_rows)) OVER () AS share,
        sum(weight) / sum(sum(weight)) OVER () AS effective_share
    FROM fed_b
    GROUP BY source, condition
)
SELECT
    source,
    condition,
    coalesce(of_a.drawn, 0)::BIGINT AS drawn_a,
    coalesce(of_b.drawn, 0)::BIGINT AS drawn_b,
    coalesce(of_a.share, 0) AS share_a,
    coalesce(of_b.share, 0) AS share_b,
    coalesce(of_a.effective_share, 0) AS effective_share_a,
    coalesce(of_b.effective_share, 0) AS effective_share_b,
    coalesce(of_a.episodes, 0) AS episodes_a,
    coalesce(of_b.episodes, 0) AS episodes_b
FROM of_a
FULL JOIN of_b USING (source, condition)
ORDER BY source, condition
