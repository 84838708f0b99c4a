-- Rows and episodes that a mixture and the coverage audits need and the store lacks: FROM gaps('coverage').
-- `planned_gaps` is a Python function (shopping_list.py). Its argument is the name of a shipped mixture or
-- the path of a TOML file.
CREATE OR REPLACE MACRO gaps(name) AS TABLE
SELECT unnest(planned_gaps(name), recursive := true);
