-- severity: warning
-- advice: Compare policies per condition, or weight each condition by its frequency in the whole fleet.
-- doc: Behaviour policies whose success looks better than it is, because they drove easier episodes than the fleet.
WITH kinds AS (
    SELECT first_policy AS behaviour_policy, kind, success
    FROM episode_kinds($min_steps)
    WHERE success IS NOT NULL
), fleet AS (
    SELECT kind, count(*) / sum(count(*)) OVER () AS share FROM kinds GROUP BY kind
), by_kind AS (
    SELECT behaviour_policy, kind, count(*) AS episodes, avg(success::INTEGER) AS success_share
    FROM kinds
    GROUP BY behaviour_policy, kind
), by_policy AS (
    SELECT
        behaviour_policy,
        sum(episodes) AS episodes,
        sum(success_share * episodes) / sum(episodes) AS success_share,
        -- Weighted by the fleet's frequency of each kind, over the kinds that this policy drove.
        sum(success_share * share) / sum(share) AS success_share_in_fleet_mix,
        sum(share) AS kinds_driven_share
    FROM by_kind
    JOIN fleet USING (kind)
    GROUP BY behaviour_policy
)
FROM by_policy
WHERE success_share - success_share_in_fleet_mix > $max_bias
    -- It did not drive the kinds in which the fleet failed.
    OR (
        kinds_driven_share < $min_kinds_share
        AND success_share - (SELECT avg(success::INTEGER) FROM kinds) > $max_bias
    )
ORDER BY behaviour_policy
