-- severity: info
-- needs: panel
-- advice: Loss, Q and reward averaged over batches of this panel are not those of the fleet: read them per stratum.
-- doc: Strata that the panel shows more often than the logs do.
SELECT name AS stratum, share, effective_share, natural_share
FROM panel.strata
WHERE share > $max_ratio * natural_share
ORDER BY share DESC
