-- The replay audit: one row per sampled transition, from the table `audit` of a run. Its clock counts
-- updates: a row was collected before the last target sync if gradient_step - age_steps < target_sync_step.
-- A fresh row's id is computed from its episode and step. It is negative, so it differs from a store's ids.
-- {schema} is the run's schema. `action_names` has the names of its task's actions; it is empty for an
-- older run.
CREATE VIEW "{schema}".replay_audit AS
SELECT
    CASE
        WHEN source = 'fresh' THEN -1 - (episode::BIGINT * 1048576 + episode_step)
        ELSE transition_id
    END AS transition_id,
    age_gradient_steps AS age_steps,
    age_days,
    condition,
    behaviour_policy AS behavior_policy,
    coalesce(name, 'action ' || action) AS action,
    reward,
    last_target_sync AS target_sync_step,
    gradient_step,
    source,
    batch_row
FROM (
    FROM "{schema}".audit
    UNION ALL BY NAME  -- columns that an older run lacks become null
    SELECT
        NULL::BIGINT AS transition_id, NULL::VARCHAR AS source, NULL::VARCHAR AS episode,
        NULL::INTEGER AS episode_step, NULL::BIGINT AS age_gradient_steps, NULL::DOUBLE AS age_days,
        NULL::VARCHAR AS condition, NULL::VARCHAR AS behaviour_policy, NULL::SMALLINT AS action,
        NULL::DOUBLE AS reward, NULL::BIGINT AS last_target_sync,
        NULL::BIGINT AS gradient_step, NULL::INTEGER AS batch_row
    WHERE false
)
LEFT JOIN "{schema}".action_names USING (action)
ORDER BY gradient_step, batch_row;

COMMENT ON COLUMN "{schema}".replay_audit.transition_id
    IS 'id of a logged row in the store; for a fresh row negative: -1 - (episode * 2**20 + step)';
COMMENT ON COLUMN "{schema}".replay_audit.age_steps
    IS 'updates since it was collected; for a logged row, since the run began: it could be drawn from then on';
COMMENT ON COLUMN "{schema}".replay_audit.age_days
    IS 'days from the logging of the row to the begin of training; null for a fresh row';
COMMENT ON COLUMN "{schema}".replay_audit.condition
    IS 'condition of the row; null for a fresh row whose episode had not ended with the run';
COMMENT ON COLUMN "{schema}".replay_audit.behavior_policy IS 'policy or driver that acted';
COMMENT ON COLUMN "{schema}".replay_audit.action IS 'name of the action; `action INDEX` in an older run';
COMMENT ON COLUMN "{schema}".replay_audit.reward IS 'the n-step return of the row';
COMMENT ON COLUMN "{schema}".replay_audit.target_sync_step
    IS 'update after which the target network last changed; null if another library trained the run';
COMMENT ON COLUMN "{schema}".replay_audit.source IS 'logs | fresh';
COMMENT ON COLUMN "{schema}".replay_audit.gradient_step IS 'update whose batch contained the row';
COMMENT ON COLUMN "{schema}".replay_audit.batch_row IS 'place in the batch; `audit` has more columns of it';
COMMENT ON COLUMN "{schema}".action_names.action IS 'index of the discrete action';
COMMENT ON COLUMN "{schema}".action_names.name IS 'name of the action';
