-- severity: error
-- needs: run.fed
-- advice: If rows are too few: ingest more of them, let the twin drive more of them (practice), lower the stratum's share, or raise max_replays_per_row. If weights undid the draws: change the stratum's correction in the mixture.
-- doc: Strata with less than half of their quota in the run's batches; and strata of the logs whose share of the gradient, after weights, was smaller than their share of the panel's rows, although they were drawn at least as often.
WITH intervals AS (
    SELECT *, sum(drawn_rows) OVER (PARTITION BY gradient_steps, phase) AS fed_rows
    FROM run.fed
), quotas AS (
    SELECT
        stratum,
        sum(natural_share * fed_rows) / sum(fed_rows) AS natural_share,
        sum(wanted_share * fed_rows) / sum(fed_rows) AS wanted_share,
        sum(drawn_rows) / sum(fed_rows) AS drawn_share,
        arg_max(reason, short_share) AS reason
    FROM intervals
    GROUP BY stratum
), drawn AS (
    SELECT *, sum(drawn_rows) OVER (PARTITION BY source, gradient_steps) AS source_rows
    FROM run.strata
    WHERE source <> 'fresh'
), weighted AS (
    SELECT
        stratum,
        source,
        last(available_share ORDER BY gradient_steps) AS natural_share,
        sum(drawn_rows) / sum(sum(drawn_rows)) OVER (PARTITION BY source) AS drawn_share,
        sum(effective_share * source_rows) / sum(sum(effective_share * source_rows)) OVER (PARTITION BY source) AS effective_share
    FROM drawn
    GROUP BY stratum, source
)
SELECT stratum, 'batch' AS source, natural_share, wanted_share, drawn_share, NULL AS effective_share, reason
FROM quotas
WHERE drawn_share < $min_part * wanted_share
UNION ALL
SELECT stratum, source, natural_share, NULL, drawn_share, effective_share, 'weights undid what was drawn'
FROM weighted
WHERE drawn_share >= natural_share AND effective_share < (1 - $max_loss) * natural_share
ORDER BY stratum, source
