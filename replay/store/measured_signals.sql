-- One value an episode of each signal, from the rows. Where manifests keep them (summaries.sql),
-- nothing is scanned. Not in Spark's list of views.
CREATE OR REPLACE VIEW measured_signals AS
-- include: measured_signals.sql
;
