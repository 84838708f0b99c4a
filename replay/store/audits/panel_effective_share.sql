-- severity: error
-- needs: panel
-- advice: The stratum's correction undoes its quota: set unit = "episode" in the mixture, or [correction] post = "density_ratio" or "none".
-- doc: Strata of the panel whose share of the gradient, after weights, is smaller than in the plain logs, although they are drawn at least as often; or whose own correction reduces it further.
WITH of_source AS (
    SELECT
        name AS stratum,
        source,
        correction,
        natural_share,
        share / sum(share) OVER (PARTITION BY source) AS drawn_share,
        effective_share / sum(effective_share) OVER (PARTITION BY source) AS effective_share
    FROM panel.strata
)
SELECT stratum, source, correction, natural_share, drawn_share, effective_share
FROM of_source
WHERE effective_share < (1 - $max_loss) * least(natural_share, drawn_share)
    AND (correction <> 'none' OR drawn_share >= (1 - $max_loss) * natural_share)
ORDER BY effective_share / natural_share
