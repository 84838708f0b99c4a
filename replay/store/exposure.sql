-- Exposures: the situations that rows were in, whatever came of them, beside their conditions. Views
-- over `recordings`, `transitions` and `episodes`; Spark has them too. Rows of an older store have no
-- exposures: there they are null, and count as in none.

-- The exposures that are told of the store's rows, of the newest ingest.
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

-- One line for each exposure that holds in a row.
CREATE OR REPLACE VIEW held_exposures AS
SELECT transition_id, recording_id, episode_id, unnest(exposures) AS exposure, action, zone, robot
FROM transitions;

-- One line an exposure, those never met included: of all its rows and episodes, whatever came of them.
CREATE OR REPLACE VIEW coverage_by_exposure AS
SELECT
    exposure,
    coalesce(rows, 0) AS rows,
    coalesce(rows, 0) / nullif(all_rows, 0) AS share,
    coalesce(episodes, 0) AS episodes,
    coalesce(episodes, 0) / nullif(all_episodes, 0) AS episode_share,
    success_share,
    return_mean,
    coalesce(actions, 0) AS actions,
    coalesce(zones, 0) AS zones
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
CROSS JOIN (SELECT count(*) AS all_rows, count(DISTINCT episode_id) AS all_episodes FROM transitions)
ORDER BY episodes DESC, exposure;
