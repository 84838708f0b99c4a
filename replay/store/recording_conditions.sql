-- Counts per recording and cell, by a scan of all rows. summaries.sql reads them from manifests instead.
CREATE OR REPLACE VIEW recording_cells AS
SELECT recording_id, primary_condition AS condition, action, behaviour_policy, count(*) AS rows
FROM transitions
GROUP BY ALL;

CREATE OR REPLACE VIEW recording_conditions AS
SELECT recording_id, primary_condition AS condition, count(*) AS rows, count(DISTINCT episode_id) AS episodes
FROM transitions
GROUP BY ALL;
