-- The two tables of a store as views, over stored_transitions and stored_recordings (its Parquet as
-- it lies, or that of several stores): all other views are of these.

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
FROM stored_recordings
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
