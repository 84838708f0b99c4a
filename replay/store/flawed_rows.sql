-- Rows with values that none may have, from the rows. Where manifests name them (summaries.sql),
-- nothing is scanned. Not in Spark's list of views.
CREATE OR REPLACE VIEW flawed_rows AS
-- include: flawed_rows.sql
;
