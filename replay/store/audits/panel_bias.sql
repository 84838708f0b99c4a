-- severity: info
-- needs: panel
-- advice: Loss, Q and reward averaged over batches of this panel are not those of the fleet: look at them per stratum.
-- doc: Strata that are more frequent in the panel than in the logs.
SELECT name AS stratum, share, effective_share, natural_share
FROM panel.strata
WHERE share > $max_ratio * natural_share
ORDER BY share DESC
