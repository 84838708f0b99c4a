-- severity: warning
-- advice: Choose on the situation: use a stratum for the exposure in the row in place of this condition's (`[each_condition]` with `kind = "exposure"` does so for all), so that episodes that handled it well are replayed, too.
-- doc: Conditions whose episodes succeed much less often than all episodes in the same situation (the exposure that most of them met): a stratum of them is chosen on its outcome.
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
