-- Labelled events, and sequences of steps that may be missed events, most doubtful first.
-- `margin` is large if the label is likely right. If the condition has a probability, it is the mean log
-- odds of the rows that the label (or its absence) is right: a negative value contradicts it. Else it is
-- log2 of the number of steps, because short events are wrong more often.
WITH rules AS (
    SELECT
        ingest_id,
        logged_start_time,
        unnest(from_json(conditions_json, '[{"name": "VARCHAR"}]')).name AS condition
    FROM recordings
), judged AS (
    SELECT
        t.transition_id,
        t.recording_id,
        t.source_file,
        t.episode_id,
        t.step_index,
        t.logged_ns,
        epoch_ns(r.logged_start_time) AS recording_start_ns,
        r.condition,
        list_contains(t.conditions, r.condition) AS labelled,
        t.probabilities[r.condition]::DOUBLE AS probability
    FROM transitions AS t
    JOIN rules AS r USING (ingest_id)
    LEFT JOIN corrections AS c
        ON c.recording_id = t.recording_id
        AND c.condition = r.condition
        AND t.logged_ns BETWEEN c.first_ns AND c.last_ns
    WHERE c.condition IS NULL -- leave out steps with a verdict
), stretches AS (
    SELECT
        condition,
        labelled,
        episode_id,
        any_value(recording_id) AS recording_id,
        any_value(source_file) AS source_file,
        arg_min(transition_id, step_index) AS transition_id,
        min(step_index) AS first_step,
        max(step_index) AS last_step,
        min(logged_ns) AS first_ns,
        max(logged_ns) AS last_ns,
        any_value(recording_start_ns) AS recording_start_ns,
        avg(probability) AS probability,
        avg(ln((probability + 1e-4) / (1 + 1e-4 - probability))) * if(labelled, 1, -1) AS log_odds
    FROM (
        SELECT
            *,
            step_index - row_number() OVER (
                PARTITION BY episode_id, condition, labelled ORDER BY step_index
            ) AS stretch
        FROM judged
        WHERE labelled OR probability >= $likely
    )
    GROUP BY episode_id, condition, labelled, stretch
)
SELECT
    concat_ws('/', episode_id, concat(first_step, '-', last_step), condition) AS event,
    condition,
    labelled,
    probability,
    coalesce(log_odds, log2(last_step - first_step + 1)) AS margin,
    if(log_odds IS NULL, 'length', 'probability') AS why,
    recording_id AS recording,
    source_file,
    make_timestamp(first_ns // 1000) AS start_time,
    make_timestamp(last_ns // 1000) AS end_time,
    (first_ns - recording_start_ns) / 1e9 AS start_s,
    (last_ns - recording_start_ns) / 1e9 AS end_s,
    episode_id,
    first_step,
    last_step,
    transition_id
FROM stretches
WHERE labelled OR NOT EXISTS (
    -- Likely steps next to a labelled event are its edge, and belong to the verdict on that event.
    FROM stretches AS near
    WHERE near.labelled
        AND near.episode_id = stretches.episode_id
        AND near.condition = stretches.condition
        AND near.first_step <= stretches.last_step + $edge
        AND near.last_step >= stretches.first_step - $edge
)
ORDER BY margin, source_file, first_ns, condition
LIMIT $most
