-- Corrections of labels by people, one row per correction: a view over `recordings`.
CREATE OR REPLACE VIEW corrections AS
SELECT
    recording_id,
    source_file,
    said.condition AS condition,
    said.value AS value,
    said.episode_index AS episode_index,
    said.first_ns AS first_ns,
    said.last_ns AS last_ns,
    make_timestamp(said.first_ns // 1000) AS first_time,
    make_timestamp(said.last_ns // 1000) AS last_time,
    said.rows AS rows,
    said.given_at AS given_at
FROM (
    SELECT recording_id, source_file, unnest(corrections) AS said
    FROM recordings
)
ORDER BY source_file, first_ns, condition;
