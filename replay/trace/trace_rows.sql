-- Audited rows of a run, largest |TD error| first. `row` is the argument for `restock trace`.
SELECT
    gradient_step || '/' || batch_row AS row,
    source,
    stratum,
    condition,
    behaviour_policy,
    transition_id,
    episode,
    age_days,
    age_gradient_steps,
    last_target_sync,
    action,
    reward,
    q,
    td
FROM audit
ORDER BY abs(td) DESC, gradient_step, batch_row
LIMIT $limit
