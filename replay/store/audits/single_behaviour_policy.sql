-- severity: warning
-- advice: In this condition, the logs have only this policy's actions: explore other actions in the twin.
-- doc: Conditions that one behaviour policy drove (almost) alone.
SELECT condition, behaviour_policy, rows, rows / of_condition AS share
FROM (
    SELECT
        condition,
        behaviour_policy,
        CAST(sum(rows) AS BIGINT) AS rows,
        sum(sum(rows)) OVER (PARTITION BY condition) AS of_condition
    FROM recording_cells
    GROUP BY condition, behaviour_policy
)
WHERE rows / of_condition >= $max_share
ORDER BY condition
