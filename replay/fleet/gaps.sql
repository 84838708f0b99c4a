-- What a store lacks of what a mixture and the coverage audits ask for: FROM gaps('coverage').
-- `planned_gaps` is a function in Python (shopping_list.py), of the name of a shipped mixture or the path
-- of a TOML file.
CREATE OR REPLACE MACRO gaps(name) AS TABLE
SELECT unnest(planned_gaps(name), recursive := true);
