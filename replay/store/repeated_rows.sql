-- Rows that are also in another recording under another id: a bag and a part of it, a differently cut copy,
-- or a drive that was replayed and recorded again.
--
-- Rows are matched by content (shared_rows). For two recordings, the median shift between stamps is computed,
-- and matches within half a control period of it count. Content that occurs more than once in a recording (a
-- robot that stands still) proves nothing and is ignored. Each row is returned with the matching row of the
-- first recording, by id, that has its content.
CREATE OR REPLACE MACRO repeated_rows(min_rows) AS TABLE
WITH marked AS MATERIALIZED (
    SELECT *, min(recording_id) OVER (PARTITION BY content) AS first_recording FROM shared_rows
), enough AS (
    -- Pairs of recordings with enough contents in common; rows of other recordings are not read.
    FROM (
        SELECT recording_id, first_recording, count(*) AS alike
        FROM marked
        WHERE recording_id <> first_recording
        GROUP BY recording_id, first_recording
    )
    WHERE alike >= min_rows
), alike AS MATERIALIZED (
    SELECT *, recording_id = first_recording AS is_first
    FROM (SELECT recording_id, transition_id, episode_id, stamp_ns FROM transitions)
    JOIN (
        FROM marked
        SEMI JOIN (FROM marked SEMI JOIN enough USING (recording_id, first_recording)) USING (content)
    ) USING (recording_id, transition_id)
), matches AS (
    SELECT
        other.transition_id,
        other.recording_id,
        other.episode_id,
        one.transition_id AS same_as_transition_id,
        one.recording_id AS same_as,
        other.stamp_ns - one.stamp_ns AS later_ns
    FROM (FROM alike WHERE is_first) AS one
    JOIN (FROM alike WHERE NOT is_first) AS other USING (content)
), shifts AS (
    SELECT recording_id, same_as, quantile_disc(later_ns, 0.5) AS shift_ns
    FROM matches
    GROUP BY recording_id, same_as
), periods AS (
    SELECT recording_id, median((end_ns - start_ns) / steps) AS period_ns
    FROM (
        SELECT
            recording_id,
            min(stamp_ns) AS start_ns,
            max(stamp_ns) AS end_ns,
            max(step_index) - min(step_index) AS steps
        FROM transitions
        WHERE recording_id IN (SELECT recording_id FROM matches)
        GROUP BY recording_id, episode_id
    )
    WHERE steps > 0
    GROUP BY recording_id
)
SELECT matches.*, shift_ns
FROM matches
JOIN shifts USING (recording_id, same_as)
LEFT JOIN periods USING (recording_id)
-- Episodes of one step have no period: assume a tenth of a second.
WHERE abs(later_ns - shift_ns) <= coalesce(period_ns, 0.1e9) / 2
QUALIFY count(*) OVER (PARTITION BY recording_id, same_as) >= min_rows
ORDER BY matches.transition_id;

-- All rows that are repeated, including the first ones: rows of one `step` are the same step under several ids.
CREATE OR REPLACE MACRO same_steps() AS TABLE
SELECT transition_id, same_as_transition_id AS step FROM repeated_rows(1)
UNION
SELECT same_as_transition_id, same_as_transition_id FROM repeated_rows(1);
