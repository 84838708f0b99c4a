-- One row a sampled transition: the replay audit record, over the table `audit` of a run. Its clock is
-- updates: a row was collected before the last target sync if gradient_step - age_steps < target_sync_step.
-- A fresh row's id is made of its episode and step: negative, so that it is none of a store's.
-- {schema} is the run's; `action_names` has the names of its task's actions, none of an older run.
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
    UNION ALL BY NAME  -- what a run of an earlier Restock lacks is null
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
    IS 'of a logged row as in the store; of a fresh row negative: -1 - (episode * 2**20 + step)';
COMMENT ON COLUMN "{schema}".replay_audit.age_steps
    IS 'updates since it was collected; of a logged row since the run began, as it could be drawn from then on';
COMMENT ON COLUMN "{schema}".replay_audit.age_days
    IS 'of a logged row: days before training began; null of a fresh one';
COMMENT ON COLUMN "{schema}".replay_audit.condition
    IS 'null where the episode of a fresh row had not ended with the run';
COMMENT ON COLUMN "{schema}".replay_audit.behavior_policy IS 'who acted';
COMMENT ON COLUMN "{schema}".replay_audit.action IS 'its name; its index in a run of an earlier Restock';
COMMENT ON COLUMN "{schema}".replay_audit.reward IS 'the n-step return of the row';
COMMENT ON COLUMN "{schema}".replay_audit.target_sync_step
    IS 'update after which the target network had last moved; null where another library learnt';
COMMENT ON COLUMN "{schema}".replay_audit.source IS 'logs | fresh';
COMMENT ON COLUMN "{schema}".replay_audit.gradient_step IS 'update whose batch it was in';
COMMENT ON COLUMN "{schema}".replay_audit.batch_row IS 'its place in the batch: `audit` has more of it';
COMMENT ON COLUMN "{schema}".action_names.action IS 'index of the discrete action';
COMMENT ON COLUMN "{schema}".action_names.name IS 'of the action';
