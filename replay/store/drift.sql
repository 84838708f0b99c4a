-- Drift: which robot's wheels, lidar or floor have changed? Each week of a robot is compared with its own
-- first weeks, and with the other robots of the site in the same week.
--
-- The steps of an episode are correlated, so a step is not a sample. A sample is the median of a recording's
-- episodes, so that the error includes differences between drives (payload, route, operator). If recordings are
-- too few, a sample is one episode. Means, with a tenth trimmed at each end, are compared with Student's test,
-- whose error is estimated from the variation of a robot's samples within its periods (Yuen and Dixon 1973).
-- Events per hour are compared with a quasi-Poisson score test. p is corrected over all signals, robots and
-- periods (Benjamini and Hochberg 1995).

-- Two-sided p of Student's t for a whole number of degrees of freedom (Abramowitz and Stegun 26.7.3 and 26.7.4).
-- The caller limits these to 200, which errs on the safe side. The result is at least 1e-15.
CREATE OR REPLACE MACRO student_p(t, df) AS greatest(1e-15, CASE WHEN df % 2 = 1
    THEN 1 - (atan(abs(t) / sqrt(df)) + CASE WHEN df > 1 THEN list_sum(list_transform(
        range(0, (df - 1) // 2),
        lambda k: exp(lgamma(k + 1) - lgamma(k + 1.5) + lgamma(1.5)) * pow(1 + t * t / df, -k - 0.5)
    )) * abs(t) / sqrt(df + t * t) ELSE 0 END) * 2 / pi()
    ELSE 1 - abs(t) / sqrt(df + t * t) * list_sum(list_transform(
        range(0, df // 2),
        lambda k: exp(lgamma(k + 0.5) - lgamma(k + 1) - lgamma(0.5)) * pow(1 + t * t / df, -k)
    ))
END);

-- The 97.5 % quantile of Student's t (Hill's expansion; within .2 % from 3 degrees of freedom on).
CREATE OR REPLACE MACRO student_quantile(df) AS
    1.959964 + 2.372271 / df + 2.822499 / pow(df, 2) + 2.555853 / pow(df, 3) + 1.589537 / pow(df, 4);

-- All comparisons. `every` is the length of a period, as a date_trunc unit (day, week, month, year, decade). A
-- robot's later periods of a signal are compared with its first `reference` periods. Fewer than `least_episodes`
-- episodes on either side are too few.
CREATE OR REPLACE MACRO drift_by(every := 'week', reference := 2, least_episodes := 5) AS TABLE
WITH valued AS (
    SELECT
        signal,
        robot,
        site,
        recording_id,
        CAST(date_trunc(every, start_time) AS DATE) AS period,
        CASE WHEN compared = 'ratio' THEN ln(value) ELSE value END AS x
    FROM episode_signals
    JOIN drift_signals USING (part, signal)
), periods AS (
    SELECT
        robot,
        signal,
        period,
        row_number() OVER (PARTITION BY robot, signal ORDER BY period)
            <= least(reference, count(*) OVER (PARTITION BY robot, signal) - 1) AS is_reference
    FROM (SELECT DISTINCT robot, signal, period FROM valued)
), grouped AS ( -- a null period is the reference
    FROM valued
    UNION ALL
    SELECT * REPLACE (CAST(NULL AS DATE) AS period)
    FROM valued
    SEMI JOIN (FROM periods WHERE is_reference) AS early USING (robot, signal, period)
), samples AS (
    SELECT * EXCLUDE (recording_id), 'episodes' AS samples FROM grouped
    UNION ALL
    SELECT signal, robot, site, period, median(x), 'recordings'
    FROM grouped
    GROUP BY signal, robot, site, period, recording_id
), sorted AS (
    SELECT *, x[cut + 1] AS low, x[n - cut] AS high
    FROM (
        SELECT * EXCLUDE (x), list(x ORDER BY x) AS x, count(*) AS n, count(*) // 10 AS cut
        FROM samples
        GROUP BY ALL
    )
), spreads AS (
    SELECT
        * EXCLUDE (x, cut, low, high),
        n - 2 * cut AS kept,
        list_avg(x[cut + 1:n - cut]) AS mean,
        list_stddev_samp(x) AS spread,
        coalesce((n - 1) * list_var_samp(
            list_transform(x, lambda v: least(greatest(v, low), high))
        ), 0) AS squares -- sum of squared deviations of the winsorised values
    FROM sorted
    JOIN (SELECT signal, part, compared, matters FROM drift_signals) USING (signal)
), means AS (
    SELECT
        * EXCLUDE (squares),
        -- Variance of the mean, from the variation within the robot's periods, pooled over all of them. Samples
        -- are assumed to vary by at least a tenth of the change that matters.
        greatest(
            sum(squares) FILTER (period IS NOT NULL) OVER own
                / nullif(sum(kept - 1) FILTER (period IS NOT NULL) OVER own, 0),
            CASE compared WHEN 'ratio' THEN pow(ln(matters) / 10, 2)
                WHEN 'difference' THEN pow(matters / 10, 2) ELSE 0 END
        ) / kept AS variance,
        sum(kept - 1) FILTER (period IS NOT NULL) OVER own AS df
    FROM spreads
    WINDOW own AS (PARTITION BY robot, signal, samples)
), sized AS (
    SELECT *, CASE samples WHEN 'episodes' THEN n >= least_episodes ELSE n >= 2 AND df >= 4 END AS enough
    FROM means
), levels AS (
    SELECT
        'own reference' AS against,
        now.part,
        now.signal,
        CAST(NULL AS VARCHAR) AS zone,
        now.compared,
        now.matters,
        now.robot,
        now.site,
        now.period,
        now.samples,
        now.enough AND coalesce(early.enough, false) AS enough,
        now.n,
        coalesce(early.n, 0) AS n_reference,
        now.mean,
        early.mean AS mean_reference,
        now.variance + early.variance AS variance,
        now.df,
        early.spread
    FROM sized AS now
    JOIN periods USING (robot, signal, period)
    LEFT JOIN (FROM sized WHERE period IS NULL) AS early USING (robot, signal, samples)
    WHERE NOT is_reference
    UNION ALL
    SELECT
        'other robots',
        part,
        signal,
        NULL,
        compared,
        matters,
        robot,
        site,
        period,
        samples,
        enough AND robots > 1,
        n,
        CAST(n_site - n AS BIGINT),
        mean,
        (mean_site - mean) / nullif(robots - 1, 0) AS mean_others,
        variance + (variance_site - variance) / nullif(pow(robots - 1, 2), 0),
        pow(variance + (variance_site - variance) / nullif(pow(robots - 1, 2), 0), 2) / nullif(
            pow(variance, 2) / df
            + (fourth_site - pow(variance, 2) / df) / nullif(pow(robots - 1, 4), 0),
            0
        ),
        sqrt((square_site - spread * spread) / nullif(robots - 1, 0))
    FROM (
        SELECT
            *,
            count(*) OVER site AS robots,
            sum(n) OVER site AS n_site,
            sum(mean) OVER site AS mean_site,
            sum(variance) OVER site AS variance_site,
            sum(pow(variance, 2) / df) OVER site AS fourth_site,
            sum(spread * spread) OVER site AS square_site
        FROM sized
        WHERE period IS NOT NULL AND enough
        WINDOW site AS (PARTITION BY site, signal, period, samples)
    )
), counted AS (
    SELECT
        condition,
        zone,
        robot,
        site,
        recording_id,
        CAST(date_trunc(every, start_time) AS DATE) AS period,
        count(*) AS episodes,
        sum(driven_h) AS driven_h,
        sum(events) AS events,
        sum(events * events / driven_h) AS squares
    FROM episode_conditions
    GROUP BY ALL
), driven_periods AS (
    SELECT
        robot,
        period,
        row_number() OVER (PARTITION BY robot ORDER BY period)
            <= least(reference, count(*) OVER (PARTITION BY robot) - 1) AS is_reference
    FROM (SELECT DISTINCT robot, period FROM counted)
), counts AS (
    SELECT * EXCLUDE (recording_id), 'episodes' AS samples FROM counted
    UNION ALL
    SELECT
        * EXCLUDE (recording_id) REPLACE (1 AS episodes, events * events / driven_h AS squares),
        'recordings'
    FROM counted
), rates AS ( -- a null period is the reference
    SELECT
        condition,
        zone,
        robot,
        site,
        period,
        samples,
        CAST(sum(episodes) AS BIGINT) AS n,
        sum(events) AS events,
        sum(driven_h) AS driven_h,
        -- Pearson's: the sum of (events - expected)^2 / expected
        coalesce(sum(driven_h) * sum(squares) / nullif(sum(events), 0) - sum(events), 0) AS residual
    FROM (
        FROM counts
        UNION ALL
        SELECT * REPLACE (CAST(NULL AS DATE) AS period)
        FROM counts
        SEMI JOIN (FROM driven_periods WHERE is_reference) AS early USING (robot, period)
    )
    GROUP BY condition, zone, robot, site, period, samples
), dispersed AS (
    SELECT
        *,
        greatest(1, sum(residual) FILTER (period IS NOT NULL) OVER own
            / nullif(sum(n - 1) FILTER (period IS NOT NULL) OVER own, 0)) AS dispersion,
        sum(n - 1) FILTER (period IS NOT NULL) OVER own AS df
    FROM rates
    WINDOW own AS (PARTITION BY condition, zone, robot, samples)
), changed_rates AS (
    SELECT
        now.*,
        early.n AS n_reference,
        early.events AS events_reference,
        early.driven_h AS driven_h_reference,
        now.events + early.events >= 5 AND CASE now.samples
            WHEN 'episodes' THEN least(now.n, early.n) >= least_episodes
            ELSE least(now.n, early.n) >= 2 AND now.df >= 4
        END AS enough
    FROM dispersed AS now
    LEFT JOIN (FROM dispersed WHERE period IS NULL) AS early
        ON early.condition = now.condition
        AND early.zone IS NOT DISTINCT FROM now.zone
        AND early.robot = now.robot
        AND early.samples = now.samples
    ANTI JOIN (FROM driven_periods WHERE is_reference) AS reference_periods
        ON reference_periods.robot = now.robot AND reference_periods.period = now.period
    WHERE now.period IS NOT NULL
), compared_all AS (
    SELECT
        *,
        mean - mean_reference AS difference,
        CASE WHEN variance > 0 THEN (mean - mean_reference) / sqrt(variance) END AS t,
        CASE compared WHEN 'ratio' THEN exp(mean) ELSE mean END AS value,
        CASE compared WHEN 'ratio' THEN exp(mean_reference) ELSE mean_reference END AS reference_value
    FROM levels
    UNION ALL BY NAME
    SELECT
        'own reference' AS against,
        'conditions' AS part,
        condition AS signal,
        zone,
        'ratio' AS compared,
        1.5 AS matters,
        robot,
        site,
        period,
        samples,
        coalesce(enough, false) AS enough,
        n,
        coalesce(n_reference, 0) AS n_reference,
        ln((events + 0.5) / driven_h * driven_h_reference / (events_reference + 0.5)) AS difference,
        dispersion * (1 / (events + 0.5) + 1 / (events_reference + 0.5)) AS variance,
        df,
        (events * driven_h_reference - events_reference * driven_h) / sqrt(
            dispersion * (events + events_reference) * driven_h * driven_h_reference
        ) AS t,
        events / driven_h AS value,
        events_reference / driven_h_reference AS reference_value
    FROM changed_rates
), chosen AS (
    FROM compared_all
    -- Compare recordings if there are enough of them, else episodes.
    QUALIFY row_number() OVER (
        PARTITION BY against, part, signal, zone, robot, period
        ORDER BY enough DESC, (samples = 'recordings') = enough DESC
    ) = 1
), measured AS (
    SELECT
        * REPLACE (greatest(1, least(200, floor(df)))::INTEGER AS df),
        CASE compared WHEN 'ratio' THEN 1 WHEN 'difference' THEN 1 ELSE nullif(spread, 0) END AS unit,
        CASE compared WHEN 'ratio' THEN ln(matters) ELSE matters END AS step
    FROM chosen
), tested AS (
    SELECT
        * REPLACE (CASE WHEN enough THEN difference / unit END AS difference, variance / unit / unit AS variance),
        CASE WHEN NOT enough THEN NULL
            WHEN difference = 0 THEN 1
            WHEN variance > 0 THEN student_p(t, df)
        END AS p,
        student_quantile(df) * sqrt(variance) / unit AS half,
        against || CASE WHEN part IN ('driving', 'conditions', 'custom') THEN part ELSE 'robot' END AS family
    FROM measured
), corrected AS (
    SELECT
        *,
        least(1, min(p * of_family / place) OVER (
            PARTITION BY family ORDER BY place DESC ROWS UNBOUNDED PRECEDING
        )) AS q
    FROM (
        SELECT
            *,
            count(p) OVER (PARTITION BY family) AS of_family,
            row_number() OVER (PARTITION BY family ORDER BY p) AS place
        FROM tested
    )
), judged AS (
    SELECT
        * REPLACE (CASE WHEN p IS NOT NULL THEN q END AS q),
        abs(difference) / step AS size,
        CASE
            WHEN NOT enough THEN 'too few'
            WHEN q < 0.05 AND abs(difference) >= step THEN 'changed'
            WHEN abs(difference) + half < step THEN 'unchanged'
            ELSE 'undecided'
        END AS verdict
    FROM corrected
), beside AS (
    SELECT
        *,
        count(p) OVER site - 1 AS others,
        count(*) FILTER (verdict = 'changed' AND difference > 0) OVER site AS risen,
        count(*) FILTER (verdict = 'changed' AND difference < 0) OVER site AS fallen,
        difference - (sum(difference) OVER site - difference) / nullif(count(p) OVER site - 1, 0) AS apart,
        sqrt(
            variance
            + (sum(variance) FILTER (p IS NOT NULL) OVER site - variance) / pow(nullif(count(p) OVER site - 1, 0), 2)
        ) AS apart_error
    FROM judged
    WINDOW site AS (PARTITION BY against, site, part, signal, zone, period)
)
SELECT
    robot,
    site,
    period,
    against,
    part,
    signal,
    zone,
    CASE
        WHEN against = 'own reference' THEN verdict
        WHEN verdict = 'changed' THEN 'differs'
        WHEN verdict = 'unchanged' THEN 'alike'
        ELSE verdict
    END AS verdict,
    CASE
        WHEN verdict <> 'changed' OR against = 'other robots' THEN NULL
        WHEN others = 0 THEN 'alone'
        WHEN abs(apart) < abs(difference) / 2 THEN 'site'
        WHEN abs(apart) > 2 * apart_error THEN 'robot'
        ELSE 'unclear'
    END AS scope,
    reference_value,
    value,
    compared,
    CASE compared WHEN 'ratio' THEN exp(difference) ELSE difference END AS change,
    CASE compared WHEN 'ratio' THEN exp(difference - half) ELSE difference - half END AS change_low,
    CASE compared WHEN 'ratio' THEN exp(difference + half) ELSE difference + half END AS change_high,
    matters,
    size,
    p,
    q,
    samples,
    n,
    n_reference,
    greatest(others, 0) AS others,
    CASE WHEN difference > 0 THEN risen ELSE fallen END - CAST(verdict = 'changed' AS INTEGER)
        AS others_changed
FROM beside
ORDER BY robot, against DESC, part, signal, zone NULLS FIRST, period;

CREATE OR REPLACE VIEW drift AS FROM drift_by();

-- One row for each robot and signal (or condition) that changed against the robot's own reference. `tests` names
-- a table with the result of drift_by, `every` is the length of its periods.
CREATE OR REPLACE MACRO drift_findings_of(tests, every := 'week') AS TABLE
SELECT
    robot,
    site,
    part,
    signal,
    zone,
    arg_max(scope, period) AS scope,
    min(period) AS since,
    count(*) AS periods,
    any_value(periods_tested) AS periods_tested,
    arg_max(compared, period) AS compared,
    arg_max(change, period) AS change,
    arg_max(change_low, period) AS change_low,
    arg_max(change_high, period) AS change_high,
    arg_max(size, period) AS size,
    max(q) AS q,
    any_value(robot) || ': ' || any_value(part) || ': '
    || any_value(signal) || CASE WHEN any_value(part) = 'conditions' THEN ' events per hour' ELSE '' END
    || coalesce(' in ' || any_value(zone), '')
    || CASE arg_max(compared, period)
        WHEN 'ratio' THEN printf(
            ' %.3g [%.3g, %.3g] times its reference', arg_max(change, period),
            arg_max(change_low, period), arg_max(change_high, period)
        )
        ELSE printf(
            ' %+.3g [%+.3g, %+.3g]', arg_max(change, period),
            arg_max(change_low, period), arg_max(change_high, period)
        ) || CASE arg_max(compared, period) WHEN 'spread' THEN ' standard deviations' ELSE '' END
        || ' from its reference'
    END
    || printf(
        ' since %s (%d of %d %ss); ',
        min(period), count(*), any_value(periods_tested), every
    )
    || CASE arg_max(scope, period)
        WHEN 'alone' THEN 'no other robot at this site to compare with'
        WHEN 'site' THEN 'the other robots at this site changed alike'
        WHEN 'robot' THEN printf(
            '%d of %d other robots at this site changed alike',
            arg_max(others_changed, period), arg_max(others, period)
        )
        ELSE 'unclear whether the other robots at this site changed alike'
    END
    || CASE arg_max(samples, period)
        WHEN 'episodes' THEN '; compared by episode, because recordings are few: these may differ as much'
        ELSE ''
    END AS finding
FROM (
    SELECT *, count(p) OVER (PARTITION BY robot, part, signal, zone) AS periods_tested
    FROM query_table(tests)
    WHERE against = 'own reference'
)
WHERE verdict = 'changed'
GROUP BY robot, site, part, signal, zone
ORDER BY part IN ('driving', 'conditions'), size DESC;

CREATE OR REPLACE VIEW drift_findings AS FROM drift_findings_of('drift');
