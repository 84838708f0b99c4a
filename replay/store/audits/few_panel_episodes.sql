-- severity: warning
-- needs: panel
-- advice: Every draw of this stratum is from these few episodes: cap its share, or set min_episodes in the mixture and add episodes.
-- doc: Strata of the panel that are drawn from so few episodes that they are worth fewer still.
SELECT name AS stratum, share, rows, episodes, effective_episodes
FROM panel.strata
WHERE share > 0 AND effective_episodes < $min_effective_episodes
ORDER BY effective_episodes, stratum
