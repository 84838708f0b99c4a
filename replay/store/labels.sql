-- Quality of labels, in recordings where a simulator recorded the true conditions: views over `recordings`
-- and `transitions`.

-- Scores of each recording, by step and by event.
CREATE OR REPLACE VIEW label_scores AS
SELECT
    scores.recording_id,
    scores.condition,
    scores.precision,
    scores.recall,
    scores.labelled,
    scores.support,
    coalesce(counts.agreed, 0) AS agreed,
    counts.known,
    counts.event_right / nullif(counts.event_labelled, 0) AS event_precision,
    counts.event_found / nullif(counts.event_support, 0) AS event_recall,
    counts.event_labelled,
    counts.event_right,
    counts.event_support,
    counts.event_found
FROM (
    SELECT
        recording_id,
        score.condition AS condition,
        score.precision AS precision,
        score.recall AS recall,
        score.labelled AS labelled,
        score.support AS support
    FROM (SELECT recording_id, unnest(label_scores) AS score FROM recordings)
) AS scores
LEFT JOIN (
    SELECT
        recording_id,
        score.condition AS condition,
        score.agreed AS agreed,
        score.known AS known,
        score.event_labelled AS event_labelled,
        score.event_right AS event_right,
        score.event_support AS event_support,
        score.event_found AS event_found
    FROM (SELECT recording_id, unnest(label_counts) AS score FROM recordings)
) AS counts ON scores.recording_id = counts.recording_id AND scores.condition = counts.condition
ORDER BY recording_id, condition;

-- Scores over all recordings, from the sums of their counts.
CREATE OR REPLACE VIEW pooled_label_scores AS
SELECT
    condition,
    sum(agreed) / nullif(sum(labelled), 0) AS precision,
    sum(agreed) / nullif(sum(support), 0) AS recall,
    CAST(sum(labelled) AS BIGINT) AS labelled,
    CAST(sum(support) AS BIGINT) AS support,
    sum(event_right) / nullif(sum(event_labelled), 0) AS event_precision,
    sum(event_found) / nullif(sum(event_support), 0) AS event_recall,
    CAST(sum(event_labelled) AS BIGINT) AS event_labelled,
    CAST(sum(event_support) AS BIGINT) AS event_support
FROM label_scores
GROUP BY condition
ORDER BY condition;

-- Calibration: of rows with a probability near p, a share of about p should be true. By tenths of probability.
CREATE OR REPLACE VIEW label_reliability AS
SELECT
    condition,
    least(CAST(floor(probability * 10) AS INTEGER), 9) / 10 AS from_probability,
    count(*) AS rows,
    avg(probability) AS mean_probability,
    avg(CASE WHEN true_condition IS NOT NULL
        THEN CAST(list_contains(string_split(true_condition, ','), condition) AS INTEGER)
    END) AS true_share,
    count(true_condition) AS known
FROM (
    SELECT true_condition, entry.key AS condition, CAST(entry.value AS DOUBLE) AS probability
    FROM (
        SELECT true_condition, unnest(map_entries(probabilities)) AS entry
        FROM transitions
    )
)
GROUP BY condition, from_probability
ORDER BY condition, from_probability;
