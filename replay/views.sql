-- The views of a store, over stored_transitions and stored_recordings (its Parquet as it lies).
-- Every column is documented in columns.toml, and a test holds that.

-- A recording's manifest row is committed before its transitions: an ingest that was cut between
-- the two is in stored_recordings and in no view.
CREATE OR REPLACE VIEW recordings AS
FROM stored_recordings
WHERE ingest_id IN (SELECT ingest_id FROM stored_transitions);

CREATE OR REPLACE VIEW transitions AS
SELECT * REPLACE (observation::FLOAT[] AS observation, next_observation::FLOAT[] AS next_observation)
FROM stored_transitions
WHERE ingest_id IN (SELECT ingest_id FROM stored_recordings);
