-- severity: info
-- needs: panel
-- advice: Mean loss, Q and reward over batches of this panel differ from those of the fleet: look at them per stratum.
-- doc: Strata that are more frequent in the panel than in the logs.
SELECT name AS stratum, share, effective_share, natural_share
FROM panel.strata
WHERE share > $max_ratio * natural_share
ORDER BY share DESC
