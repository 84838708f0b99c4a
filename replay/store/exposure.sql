-- Exposures: the situations of rows, whatever the outcome. Views over `recordings`, `transitions` and `episodes`.

-- The exposures of the newest ingest.
CREATE OR REPLACE VIEW exposures AS
SELECT
    spec.name AS exposure,
    spec.priority AS priority,
    spec.sql AS sql,
    labels_version
FROM (
    SELECT
        labels_version,
        unnest(from_json(
            exposures_json,
            '[{"name": "VARCHAR", "timing": "VARCHAR", "priority": "INTEGER", "sql": "VARCHAR"}]'
        )) AS spec
    FROM (SELECT * FROM recordings ORDER BY ingested_at DESC, ingest_id LIMIT 1)
);

-- One row for each transition and exposure that holds in it.
CREATE OR REPLACE VIEW held_exposures AS
SELECT transition_id, recording_id, episode_id, unnest(exposures) AS exposure, action, zone, robot
FROM transitions;

-- One row per exposure, including exposures never met: all its rows and episodes, whatever the outcome. Counts
-- are null if the exposure is unknown in all recordings.
CREATE OR REPLACE VIEW coverage_by_exposure AS
SELECT
    exposure,
    coalesce(rows, least) AS rows,
    coalesce(rows, least) / nullif(all_rows, 0) AS share,
    coalesce(episodes, least) AS episodes,
    coalesce(episodes, least) / nullif(all_episodes, 0) AS episode_share,
    success_share,
    return_mean,
    coalesce(actions, least) AS actions,
    coalesce(zones, least) AS zones
FROM exposures
FULL JOIN (
    SELECT
        exposure,
        count(*) AS rows,
        count(DISTINCT action) AS actions,
        count(DISTINCT zone) AS zones
    FROM held_exposures
    GROUP BY exposure
) AS held USING (exposure)
FULL JOIN (
    SELECT
        exposure,
        count(*) AS episodes,
        avg(CAST(success AS INTEGER)) AS success_share,
        avg(return) AS return_mean
    FROM (SELECT DISTINCT exposure, episode_id FROM held_exposures)
    JOIN episodes USING (episode_id)
    GROUP BY exposure
) AS by_episode USING (exposure)
LEFT JOIN (
    SELECT exposure, 0 AS least
    FROM exposures
    ANTI JOIN (SELECT condition AS exposure FROM untold_conditions) AS untold USING (exposure)
) AS told USING (exposure)
CROSS JOIN (SELECT count(*) AS all_rows, count(DISTINCT episode_id) AS all_episodes FROM transitions)
ORDER BY episodes DESC, exposure;

-- Each condition compared with the situations that its episodes met: does a stratum of the condition leave out
-- episodes that went well? One row per condition and exposure that share episodes. `situation` 1 is the
-- condition's situation: among the exposures that at least half of its episodes met, the one that other
-- episodes meet least.
CREATE OR REPLACE VIEW success_by_exposure AS
WITH met AS (
    SELECT DISTINCT exposure, episode_id FROM held_exposures
), named AS (
    SELECT unnest(conditions) AS condition, episode_id FROM episodes
), judged AS (
    SELECT episode_id, CAST(success AS DOUBLE) AS success FROM episodes WHERE success IS NOT NULL
), of_condition AS (
    SELECT condition, count(*) AS episodes, avg(success) AS success_share
    FROM named
    JOIN judged USING (episode_id)
    GROUP BY condition
), of_exposure AS (
    SELECT exposure, count(*) AS exposed_episodes, avg(success) AS exposed_success_share
    FROM met
    JOIN judged USING (episode_id)
    GROUP BY exposure
), shared AS (
    SELECT condition, exposure, count(*) AS shared_episodes, sum(success) AS shared_successes
    FROM named
    JOIN met USING (episode_id)
    JOIN judged USING (episode_id)
    GROUP BY condition, exposure
), counted AS (
    SELECT
        condition,
        exposure,
        episodes,
        success_share,
        exposed_episodes,
        exposed_success_share,
        shared_episodes / episodes AS met_share,
        exposed_episodes - shared_episodes AS left_out_episodes,
        (exposed_episodes * exposed_success_share - shared_successes)
            / nullif(exposed_episodes - shared_episodes, 0) AS left_out_success_share
    FROM shared
    JOIN of_condition USING (condition)
    JOIN of_exposure USING (exposure)
)
SELECT
    condition,
    exposure,
    row_number() OVER (
        PARTITION BY condition
        ORDER BY met_share < 0.5, met_share / exposed_episodes DESC, exposure
    ) AS situation,
    episodes,
    success_share,
    exposed_episodes,
    exposed_success_share,
    met_share,
    left_out_episodes,
    left_out_success_share,
    -- The difference of the two shares, in its standard errors under the assumption of equal shares.
    (left_out_success_share - success_share) / nullif(sqrt(
        (episodes * success_share + left_out_episodes * left_out_success_share)
        / (episodes + left_out_episodes)
        * (1 - (episodes * success_share + left_out_episodes * left_out_success_share)
            / (episodes + left_out_episodes))
        * (1 / episodes + 1 / left_out_episodes)
    ), 0) AS z
FROM counted
ORDER BY condition, situation;
