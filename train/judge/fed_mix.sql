-- What one run's critic was fed, by episode, cell (source/condition) and tenth of its training.
-- `fed` is the run's sampled_episodes. Strata are not used: two runs' mixtures may name them
-- differently.
WITH drawn AS (
    SELECT *, max(gradient_steps) OVER () AS whole FROM fed
)
SELECT source || '/' || condition AS cell,
       least((gradient_steps * 10 - 1) // whole, 9)::BIGINT AS tenth,
       source,
       episode,
       sum(drawn_rows)::DOUBLE AS drawn,
       sum(weight)::DOUBLE AS weight
FROM drawn
GROUP BY ALL
ORDER BY ALL
