-- Rows with invalid values, by a scan of all rows. summaries.sql reads them from manifests instead.
CREATE OR REPLACE VIEW flawed_rows AS
-- include: flawed_rows.sql
;
