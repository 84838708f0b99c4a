-- Does more success earn more return? Macros over the table of driven episodes that `source` names
-- (`driven_episodes` of a store, see returns.sql, or of a run, see run_returns.sql), with the columns
--
--     mission (null: each driver had its own missions), driver, handed_over, condition, outcome,
--     success, return, discounted_return

-- The .975 quantile of Student's t, by its expansion in the normal quantile (Abramowitz and Stegun 26.7.5),
-- within 1 %; null below 2 degrees of freedom, as the spread of one or two episodes means nothing.
CREATE OR REPLACE MACRO student_t_975(freedom) AS CASE
    WHEN freedom >= 2 THEN 1.96
        + 2.3723 / freedom
        + 2.8225 / pow(freedom, 2)
        + 2.5558 / pow(freedom, 3)
        + 1.5895 / pow(freedom, 4)
END;

-- One row per condition, driver and outcome, and one per condition and driver with outcome `all`.
CREATE OR REPLACE MACRO returns_of(source) AS TABLE
SELECT
    condition,
    driver,
    CASE WHEN grouping(outcome) = 1 THEN 'all' ELSE outcome END AS outcome,
    count(*) AS episodes,
    avg(success::INTEGER) AS success_share,
    avg(return) AS return_mean,
    avg(discounted_return) AS discounted_mean,
    discounted_mean
        - student_t_975(count(*) - 1) * stddev_samp(discounted_return) / sqrt(count(*)) AS discounted_low,
    discounted_mean
        + student_t_975(count(*) - 1) * stddev_samp(discounted_return) / sqrt(count(*)) AS discounted_high
FROM query_table(source)
GROUP BY GROUPING SETS ((condition, driver), (condition, driver, outcome))
ORDER BY condition, driver, outcome <> 'all', outcome;

-- One row per condition and pair of drivers: how much more success the more successful driver has, and how
-- much more return, each with a 95 % interval (null for the return if a driver has fewer than three episodes).
-- Drivers with the same missions are compared mission by mission. Episodes in which control was handed over
-- count for no driver, because operators are called to the harder episodes.
CREATE OR REPLACE MACRO return_order(source, min_episodes, same_success) AS TABLE
WITH driven AS (
    SELECT condition, driver, mission, success::INTEGER AS success, discounted_return AS earned
    FROM query_table(source)
    WHERE success IS NOT NULL AND discounted_return IS NOT NULL AND NOT handed_over
), by_driver AS (
    SELECT
        condition,
        driver,
        count(*) AS n,
        avg(success) AS success,
        avg(earned) AS earned,
        var_samp(earned) / count(*) AS earned_error, -- variance of the mean
        -- Wilson's interval: its centre and half width, z = 1.96.
        (avg(success) + 1.9208 / count(*)) / (1 + 3.8416 / count(*)) AS centre,
        1.96 / (1 + 3.8416 / count(*))
            * sqrt(avg(success) * (1 - avg(success)) / count(*) + 0.9604 / (count(*) * count(*))) AS half
    FROM driven
    GROUP BY condition, driver
), paired AS (
    SELECT
        a.condition AS condition,
        a.driver AS more,
        b.driver AS less,
        count(*) AS n,
        count(*) FILTER (WHERE a.success > b.success) AS only_more,
        count(*) FILTER (WHERE a.success < b.success) AS only_less,
        avg(a.success) AS success,
        avg(b.success) AS success_less,
        avg(a.earned) AS earned,
        avg(b.earned) AS earned_less,
        var_samp(a.earned - b.earned) / count(*) AS earned_error
    FROM driven AS a
    JOIN driven AS b ON a.condition = b.condition AND a.mission = b.mission AND a.driver <> b.driver
    GROUP BY a.condition, a.driver, b.driver
), differences AS (
    SELECT
        condition, more, less, n AS episodes, n AS episodes_less,
        success, success_less, earned, earned_less,
        -- Interval for paired shares: Agresti and Min, with half an episode added to each of the four cells.
        (only_more - only_less) / (n + 2) AS success_middle,
        1.96 * sqrt(only_more + only_less + 1 - pow(only_more - only_less, 2) / (n + 2)) / (n + 2) AS success_below,
        success_below AS success_above,
        student_t_975(n - 1) * sqrt(earned_error) AS earned_half
    FROM paired
    UNION ALL
    SELECT
        a.condition, a.driver, b.driver, a.n, b.n,
        a.success, b.success, a.earned, b.earned,
        -- Interval for the difference of two independent shares: Newcombe, from two Wilson intervals.
        a.success - b.success,
        sqrt(pow(a.success - (a.centre - a.half), 2) + pow(b.centre + b.half - b.success, 2)),
        sqrt(pow(a.centre + a.half - a.success, 2) + pow(b.success - (b.centre - b.half), 2)),
        -- Welch's interval, which has no degrees of freedom if neither return varies.
        CASE
            WHEN least(a.n, b.n) < 3 THEN NULL
            WHEN a.earned_error + b.earned_error = 0 THEN 0
            ELSE sqrt(a.earned_error + b.earned_error) * student_t_975(
                pow(a.earned_error + b.earned_error, 2)
                / (pow(a.earned_error, 2) / (a.n - 1) + pow(b.earned_error, 2) / (b.n - 1))
            )
        END
    FROM by_driver AS a
    JOIN by_driver AS b ON a.condition = b.condition AND a.driver <> b.driver
    WHERE NOT EXISTS (FROM paired WHERE paired.condition = a.condition AND more = a.driver AND less = b.driver)
), intervals AS (
    SELECT
        *,
        greatest(success_middle - success_below, -1) AS success_low,
        least(success_middle + success_above, 1) AS success_high,
        earned - earned_less - earned_half AS earned_low,
        earned - earned_less + earned_half AS earned_high
    FROM differences
    WHERE success > success_less OR (success = success_less AND more < less)
)
SELECT
    condition,
    more AS driver,
    less AS other,
    CASE
        WHEN least(episodes, episodes_less) < min_episodes THEN 'undetermined'
        WHEN success_low > 0 AND earned_high < 0 THEN 'reversed'
        WHEN success_low > 0 AND earned_low > 0 THEN 'agrees'
        WHEN success_low > -same_success AND success_high < same_success THEN 'same success'
        ELSE 'undetermined'
    END AS verdict,
    CASE
        WHEN verdict <> 'undetermined' THEN NULL
        WHEN least(episodes, episodes_less) < min_episodes THEN 'too few episodes'
        WHEN success_low > 0 THEN 'its return may be higher or lower'
        ELSE 'either driver may succeed more'
    END AS why,
    episodes,
    episodes_less AS other_episodes,
    success,
    success_less AS other_success,
    [success_low, success_high] AS more_success,
    earned AS discounted_return,
    earned_less AS other_discounted_return,
    [earned_low, earned_high] AS more_return
FROM intervals
ORDER BY condition, driver, other;

-- The pairs of drivers that too few episodes leave undecided; if there are no pairs, one row that says so.
CREATE OR REPLACE MACRO undetermined_order(source, min_episodes, same_success) AS TABLE
WITH pairs AS (FROM return_order(source, min_episodes, same_success))
SELECT condition, driver, other, why, episodes, other_episodes, more_success, more_return
FROM pairs
WHERE verdict = 'undetermined'
UNION ALL
SELECT NULL, NULL, NULL, 'no condition in which two drivers had a goal', 0, 0, NULL, NULL
WHERE NOT EXISTS (FROM pairs);
