-- severity: warning
-- advice: Change the condition's SQL and ingest again; a stratum is no better than its label.
-- doc: Conditions whose labels miss, or make up, too much, where the true condition is known.
SELECT
    condition,
    sum(precision * labelled) / sum(labelled) AS precision,
    sum(recall * support) / sum(support) AS recall,
    sum(support) AS support
FROM label_scores
GROUP BY condition
HAVING sum(support) >= $min_support
    AND (
        sum(precision * labelled) / sum(labelled) < $min_precision
        OR sum(recall * support) / sum(support) < $min_recall
    )
ORDER BY condition
