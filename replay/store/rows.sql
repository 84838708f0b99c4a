-- The views `recordings` and `transitions`, over stored_recordings and stored_transitions (the Parquet files
-- of one or several stores). All other views read these two.

-- A recording's manifest row is committed before its transitions. An ingest that was killed in between has a
-- row in stored_recordings, but is in no view.
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
FROM stored_recordings
WHERE ingest_id IN (SELECT ingest_id FROM stored_transitions);

-- Stamps may be a simulator's, which begin at zero: logged_ns is the same moment in log time. The Parquet
-- column `condition` has only the condition of highest priority: a filter on it misses rows that hold the
-- condition together with one of higher priority. The view therefore calls it `primary_condition`.
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
FROM stored_transitions AS stored
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
    FROM stored_recordings
) AS told USING (ingest_id);
