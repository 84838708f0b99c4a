-- How large a buffer must be: what the newest rows of `transitions` cover.

-- What a buffer of the newest rows covers, for capacities of all rows, half of them, a quarter, …
CREATE OR REPLACE MACRO capacity_curve() AS TABLE
WITH ranked AS (
    SELECT
        primary_condition AS condition,
        zone,
        action,
        episode_id,
        row_number() OVER (ORDER BY logged_ns DESC, transition_id DESC) AS place
    FROM transitions
), capacities AS (
    SELECT DISTINCT ceil(rows / 2.0 ^ halvings)::BIGINT AS capacity
    FROM (SELECT count(*) AS rows FROM transitions), range(0, 16) AS steps (halvings)
    WHERE ceil(rows / 2.0 ^ halvings) >= 2
), cells AS (
    SELECT condition, zone, action, min(place) AS first_place FROM ranked GROUP BY ALL
), covered AS (
    SELECT
        capacity,
        count(*) FILTER (first_place <= capacity) AS cells,
        count(*) FILTER (first_place <= capacity) / count(*) AS cells_share,
        count(DISTINCT condition) FILTER (first_place <= capacity) AS conditions
    FROM cells
    CROSS JOIN capacities
    GROUP BY capacity
), kept AS (
    SELECT capacity, count(*) AS episodes, sum(n) ^ 2 / sum(n ^ 2) AS effective_episodes
    FROM (
        SELECT capacity, episode_id, count(*) AS n
        FROM ranked
        JOIN capacities ON place <= capacity
        GROUP BY ALL
    )
    GROUP BY capacity
)
SELECT capacity, cells, cells_share, conditions, episodes, effective_episodes
FROM covered
JOIN kept USING (capacity)
ORDER BY capacity;

-- Smallest number of newest rows that has `cells_share` of the condition x zone x action cells ever seen,
-- and smallest number worth `least_episodes` effective episodes; null if all rows are worth less.
CREATE OR REPLACE MACRO capacity_needed(cells_share, least_episodes) AS TABLE
WITH ranked AS (
    SELECT
        primary_condition AS condition,
        zone,
        action,
        episode_id,
        row_number() OVER (ORDER BY logged_ns DESC, transition_id DESC) AS place
    FROM transitions
), firsts AS (
    SELECT min(place) AS place, row_number() OVER (ORDER BY min(place)) AS cells
    FROM ranked
    GROUP BY condition, zone, action
), numbered AS (
    SELECT place, row_number() OVER (PARTITION BY episode_id ORDER BY place) AS of_episode
    FROM ranked
), effective AS (  -- (sum n)^2 / sum n^2, where each episode has n of the newest `place` rows
    SELECT place, place::DOUBLE * place / sum(2 * of_episode - 1) OVER (ORDER BY place) AS episodes
    FROM numbered
)
SELECT
    (SELECT max(cells) FROM firsts) AS cells,
    (SELECT min(place) FROM firsts WHERE cells >= cells_share * (SELECT max(cells) FROM firsts))
        AS rows_for_cells,
    (SELECT min(place) FROM effective WHERE episodes >= least_episodes) AS rows_for_episodes;
