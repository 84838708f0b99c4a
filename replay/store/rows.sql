-- The two tables of a store as views, over stored_transitions and stored_recordings (its Parquet as
-- it lies, or that of several stores): all other views are of these. Columns that newer software
-- writes are null in rows of an older store. Both are written for Spark in `spark.py`.

-- A recording's manifest row is committed before its transitions: an ingest that was cut between
-- the two is in stored_recordings and in no view.
CREATE OR REPLACE VIEW recordings AS
SELECT
    *,
    tags['robot'] AS robot,
    tags['site'] AS site,
    tags['firmware'] AS firmware,
    tags['map'] AS map,
    tags['shift'] AS shift,
    make_timestamp(start_stamp_ns // 1000) AS start_stamp_time,
    make_timestamp(end_stamp_ns // 1000) AS end_stamp_time,
    make_timestamp((start_stamp_ns + coalesce(clock_offset_ns, 0)) // 1000) AS logged_start_time,
    make_timestamp((end_stamp_ns + coalesce(clock_offset_ns, 0)) // 1000) AS logged_end_time
FROM (
    FROM stored_recordings
    UNION ALL BY NAME
    SELECT
        NULL::MAP(VARCHAR, VARCHAR) AS tags,
        NULL::VARCHAR AS exposures_json,
        NULL::STRUCT(
            condition VARCHAR, kind VARCHAR, signals VARCHAR[], because VARCHAR
        )[] AS unknown_conditions,
        NULL::VARCHAR[] AS uncertain_conditions,
        NULL::STRUCT(
            condition VARCHAR, known BIGINT, labelled BIGINT, support BIGINT, agreed BIGINT,
            event_labelled BIGINT, event_right BIGINT, event_support BIGINT, event_found BIGINT
        )[] AS label_counts,
        NULL::STRUCT(
            camera VARCHAR, topic VARCHAR, "type" VARCHAR, expected BIGINT, decoded BIGINT,
            kept BIGINT, thinned BIGINT, unused BIGINT,
            problems STRUCT(reason VARCHAR, count BIGINT)[], steps BIGINT, size_bytes BIGINT,
            file VARCHAR
        )[] AS cameras
    WHERE false
)
WHERE ingest_id IN (SELECT ingest_id FROM stored_transitions);

-- Stamps can be a simulator's, which begin at zero: logged_ns is the same moment by log time. What the
-- Parquet calls `condition` is one label a row, by priority: a filter on it would leave out the rows that
-- hold the condition beside one of higher priority, so here its name says what it is.
CREATE OR REPLACE VIEW transitions AS
SELECT
    stored.* EXCLUDE (logged_ns)
    REPLACE (observation::FLOAT[] AS observation, next_observation::FLOAT[] AS next_observation)
    RENAME (condition AS primary_condition),
    coalesce(stored.logged_ns, stamp_ns + coalesce(clock_offset_ns, 0)) AS logged_ns,
    make_timestamp(stamp_ns // 1000) AS stamp_time,
    make_timestamp(
        coalesce(stored.logged_ns, stamp_ns + coalesce(clock_offset_ns, 0)) // 1000
    ) AS logged_time,
    make_timestamp(pose_stamp_ns // 1000) AS pose_stamp_time,
    told.robot AS robot,
    told.site AS site,
    told.firmware AS firmware,
    told.map AS map,
    told.shift AS shift,
    told.tags AS tags
FROM (
    FROM stored_transitions
    UNION ALL BY NAME
    SELECT
        NULL::BIGINT AS logged_ns,
        NULL::MAP(VARCHAR, FLOAT) AS probabilities,
        NULL::VARCHAR[] AS uncertain,
        NULL::VARCHAR[] AS exposures,
        NULL::VARCHAR AS true_exposure,
        NULL::VARCHAR AS goal_source,
        NULL::FLOAT AS came_nearer_m,
        NULL::FLOAT AS plan_return_m,
        NULL::FLOAT AS plan_gap_m,
        NULL::VARCHAR AS perturbation,
        NULL::MAP(VARCHAR, DOUBLE) AS perturbation_values
    WHERE false
) AS stored
JOIN (
    SELECT
        ingest_id,
        clock_offset_ns,
        tags['robot'] AS robot,
        tags['site'] AS site,
        tags['firmware'] AS firmware,
        tags['map'] AS map,
        tags['shift'] AS shift,
        tags
    FROM (
        FROM stored_recordings
        UNION ALL BY NAME
        SELECT NULL::MAP(VARCHAR, VARCHAR) AS tags WHERE false
    )
) AS told USING (ingest_id);
