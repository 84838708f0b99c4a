-- One row a step, in order: what was commanded and what was sensed. {columns} are signals.
SELECT
    transition_id,
    recording_id,
    episode_id,
    step_index,
    condition,
    true_condition,
    {columns}
FROM transitions
WHERE task_hash = $task_hash
    AND (len($recordings::VARCHAR[]) = 0 OR list_contains($recordings::VARCHAR[], recording_id))
ORDER BY recording_id, episode_index, step_index
