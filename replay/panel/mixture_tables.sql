-- A mixture's plan over a store, without building a panel: FROM mixture('coverage').
-- `planned_strata` and `planned_rows` are Python functions (mixture_tables.py). Their argument is the
-- name of a shipped mixture or the path of a TOML file.

-- One row per stratum: its rows, and its shares (natural, wanted, drawn, and effective after weights).
CREATE OR REPLACE MACRO mixture(name) AS TABLE
SELECT unnest(planned_strata(name), recursive := true);

-- One row per transition that `restock mix` would pack, with its stratum and importance weight.
CREATE OR REPLACE MACRO mixture_rows(name) AS TABLE
SELECT unnest(planned_rows(name), recursive := true);
