-- A mixture's plan over a store, before any panel is built: FROM mixture('coverage').
-- `planned_strata` and `planned_rows` are functions in Python (mixture_tables.py), of the name of a
-- shipped mixture or the path of a TOML file.

-- A row a stratum: what is there, wanted, drawn, and left of it after weights.
CREATE OR REPLACE MACRO mixture(name) AS TABLE
SELECT unnest(planned_strata(name), recursive := true);

-- A row a transition that may be drawn: its stratum and importance weight, as `restock mix` packs it.
CREATE OR REPLACE MACRO mixture_rows(name) AS TABLE
SELECT unnest(planned_rows(name), recursive := true);
