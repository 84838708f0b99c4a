-- severity: warning
-- needs: run
-- advice: Report success per condition, or weight each condition by its share of the logs; the mean over this evaluation does not predict deployment.
-- doc: Conditions that are more frequent in an evaluation of the run than in the logs.
WITH deployed AS (
    SELECT kind AS condition, count(*) / sum(count(*)) OVER () AS share_in_logs
    FROM episode_kinds($min_steps)
    GROUP BY kind
), evaluated AS (
    SELECT condition, count(*) / sum(count(*)) OVER () AS share, avg(success::INTEGER) AS success_share
    FROM run.evaluations
    WHERE env_steps = (SELECT max(env_steps) FROM run.evaluations)
    GROUP BY condition
)
SELECT condition, share, coalesce(share_in_logs, 0) AS share_in_logs, success_share
FROM evaluated
LEFT JOIN deployed USING (condition)
WHERE share > $max_ratio * coalesce(share_in_logs, 0)
    -- Only a condition that is easier than the mean of the evaluation makes this mean look better.
    AND success_share > (SELECT sum(share * success_share) FROM evaluated)
ORDER BY share DESC
