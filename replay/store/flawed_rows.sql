-- Rows with values that none may have, from the rows. Where manifests name them (summaries.sql),
-- nothing is scanned.
CREATE OR REPLACE VIEW flawed_rows AS
-- include: flawed_rows.sql
;
