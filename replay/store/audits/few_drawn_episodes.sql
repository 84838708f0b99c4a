-- severity: warning
-- needs: run.sampled_episodes
-- advice: What the critic knows about this stratum comes from these few episodes: add episodes, or treat its results as valid only for them.
-- doc: Strata that a run drew so unevenly that the draws have the information of too few episodes.
SELECT
    source,
    stratum,
    sum(drawn) AS drawn_rows,
    count(*) AS episodes,
    sum(drawn) ^ 2 / sum(drawn ^ 2) AS effective_episodes
FROM (
    SELECT source, stratum, episode, sum(drawn_rows)::DOUBLE AS drawn
    FROM run.sampled_episodes
    GROUP BY source, stratum, episode
)
WHERE stratum <> 'unlabelled'  -- not a stratum, but fresh rows of episodes that have not ended
GROUP BY source, stratum
HAVING sum(drawn) ^ 2 / sum(drawn ^ 2) < $min_effective_episodes
ORDER BY effective_episodes, source, stratum
