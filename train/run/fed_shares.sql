-- Sum the run's table `fed` over all intervals: one row per stratum, with its shares of all rows.
WITH intervals AS (
    SELECT *, row_number() OVER () AS place,
           sum(drawn_rows) OVER (PARTITION BY gradient_steps, phase) AS fed_rows
    FROM fed
), run AS (
    SELECT sum(drawn_rows) AS rows FROM fed
)
SELECT stratum,
       sum(natural_share * fed_rows) / any_value(run.rows) AS natural_share,
       sum(wanted_share * fed_rows) / any_value(run.rows) AS wanted_share,
       sum(drawn_rows) / any_value(run.rows) AS drawn_share,
       sum(logs_share * fed_rows) / any_value(run.rows) AS logs_share,
       sum(fresh_share * fed_rows) / any_value(run.rows) AS fresh_share,
       greatest(sum(wanted_share * fed_rows) / any_value(run.rows)
           - sum(drawn_rows) / any_value(run.rows), 0) AS short_share,
       arg_max(reason, short_share) FILTER (reason IS NOT NULL) AS reason,
       sum(drawn_rows)::BIGINT AS drawn_rows
FROM intervals, run
GROUP BY stratum
ORDER BY stratum = 'unlabelled', min(place)
