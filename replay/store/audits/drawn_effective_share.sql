-- severity: error
-- needs: run.strata
-- advice: Importance weights undid what the run drew of them: change their correction in the mixture, and train again.
-- doc: Strata of the logs whose share of the run's gradient, after weights, was smaller than their share of the panel's rows, although they were drawn at least as often.
WITH drawn AS (
    SELECT *, sum(drawn_rows) OVER (PARTITION BY source, gradient_steps) AS source_rows
    FROM run.strata
    WHERE source <> 'fresh'
), shares AS (
    SELECT
        stratum,
        source,
        last(available_share ORDER BY gradient_steps) AS natural_share,
        sum(drawn_rows) / sum(sum(drawn_rows)) OVER (PARTITION BY source) AS drawn_share,
        sum(effective_share * source_rows) / sum(sum(effective_share * source_rows)) OVER (PARTITION BY source) AS effective_share
    FROM drawn
    GROUP BY stratum, source
)
SELECT stratum, source, natural_share, drawn_share, effective_share
FROM shares
WHERE drawn_share >= natural_share AND effective_share < (1 - $max_loss) * natural_share
ORDER BY effective_share / natural_share
