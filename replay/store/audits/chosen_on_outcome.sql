-- severity: warning
-- advice: Replace this condition's stratum by one for the row's exposure (`[each_condition]` with `kind = "exposure"` does so for all), so that episodes that handled the situation well are replayed, too.
-- doc: Conditions whose episodes succeed much less often than all episodes in the same situation (an exposure that most of them met): a stratum for such a condition selects rows by their outcome.
SELECT
    condition,
    exposure,
    episodes,
    success_share,
    exposed_episodes,
    exposed_success_share,
    left_out_episodes,
    left_out_success_share
FROM success_by_exposure
WHERE situation = 1
    AND met_share >= 0.5
    AND episodes >= $min_episodes
    AND left_out_episodes >= $min_episodes
    AND exposed_success_share - success_share > $max_gap
    AND z > $min_z
ORDER BY exposed_success_share - success_share DESC
