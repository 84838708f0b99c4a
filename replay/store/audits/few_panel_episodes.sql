-- severity: warning
-- needs: panel
-- advice: All draws of this stratum come from these few episodes: cap its share, or set min_episodes in the mixture and add episodes.
-- doc: Strata of the panel that have the information of too few equally long episodes.
SELECT name AS stratum, share, rows, episodes, effective_episodes
FROM panel.strata
WHERE share > 0 AND effective_episodes < $min_effective_episodes
ORDER BY effective_episodes, stratum
