-- The rows (steps) of a task, in the order of driving; `{signals}` are the stored signals.
SELECT
    transition_id,
    recording_id,
    episode_id,
    step_index,
    primary_condition AS condition,
    true_condition,
    conditions,
    action,
    reward,
    progress_m,
    {signals}
FROM transitions
WHERE task_hash = $task_hash
    AND (len($recordings::VARCHAR[]) = 0 OR list_contains($recordings::VARCHAR[], recording_id))
ORDER BY recording_id, episode_index, step_index
