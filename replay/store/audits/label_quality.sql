-- severity: warning
-- advice: Change the condition's SQL and ingest again; a stratum is only as good as its label.
-- doc: Conditions whose labels have too many misses or false alarms, where the true condition is known.
SELECT
    condition,
    sum(precision * labelled) / sum(labelled) AS precision,
    sum(recall * support) / sum(support) AS recall,
    sum(support) AS support,
    sum(event_right) / nullif(sum(event_labelled), 0) AS event_precision,
    sum(event_found) / nullif(sum(event_support), 0) AS event_recall
FROM label_scores
GROUP BY condition
HAVING sum(support) >= $min_support
    AND (
        sum(precision * labelled) / sum(labelled) < $min_precision
        OR sum(recall * support) / sum(support) < $min_recall
    )
ORDER BY condition
