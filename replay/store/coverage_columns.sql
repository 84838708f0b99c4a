-- Columns of `coverage_by_condition`, from `seen` and `by_episode` (one row per condition each). Included in
-- two statements: the view that scans rows, and the view over summaries.
SELECT
    condition,
    timing,
    coalesce(rows_held, least) AS rows_held,
    coalesce(rows_held, least) / nullif(sum(primary_rows) OVER (), 0) AS held_share,
    coalesce(episodes_held, least) AS episodes_held,
    coalesce(effective_episodes, least) AS effective_episodes,
    success_share,
    return_mean,
    reward_mean,
    terminal_fraction,
    coalesce(recordings, least) AS recordings,
    coalesce(actions, least) AS actions,
    coalesce(zones, least) AS zones,
    coalesce(behaviour_policies, CASE WHEN least = 0 THEN [] END) AS behaviour_policies,
    coalesce(primary_rows, least) AS primary_rows,
    coalesce(primary_rows, least) / nullif(sum(primary_rows) OVER (), 0) AS primary_share,
    coalesce(uncertain_recordings, least) AS uncertain_recordings
FROM conditions
FULL JOIN seen USING (condition)
FULL JOIN by_episode USING (condition)
LEFT JOIN (SELECT condition, 0 AS least FROM conditions ANTI JOIN untold_conditions USING (condition)) AS told
    USING (condition)
LEFT JOIN (
    SELECT condition, count(*) AS uncertain_recordings
    FROM (SELECT unnest(uncertain_conditions) AS condition FROM recordings)
    GROUP BY condition
) AS guessed USING (condition)
ORDER BY rows_held DESC, condition
