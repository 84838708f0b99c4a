-- Converts a table of any task to rows of a store, with defaults for columns that only robot logs have.
-- `given` is the table, with `place` the number of each row. Optional columns that it lacks are null.
-- Steps of an episode are in the order of step_index, or else of rows. A row without next_observation
-- takes the next step's observation. If there is no next step, it takes its own observation if it
-- terminated (the value has no effect then), else null.
CREATE TABLE filled AS
WITH named AS (
    SELECT * REPLACE (terminated::BOOLEAN AS terminated, truncated::BOOLEAN AS truncated)
    FROM given
    UNION ALL BY NAME
    SELECT
        NULL::BIGINT AS transition_id, NULL::INTEGER AS step_index, NULL::FLOAT[] AS next_observation,
        NULL::VARCHAR AS zone, NULL::VARCHAR AS behaviour_policy, NULL::VARCHAR AS behaviour_version,
        NULL::FLOAT AS action_probability, NULL::BIGINT AS stamp_ns
    WHERE false
), counted AS (
    SELECT
        * REPLACE (
            coalesce(step_index, row_number() OVER (PARTITION BY episode ORDER BY place) - 1)::INTEGER
                AS step_index
        ),
        dense_rank() OVER (ORDER BY episode) - 1 AS episode_index,
        len(first(observation) OVER (ORDER BY place)) AS size
    FROM named
), ordered AS (
    SELECT
        *,
        lag(terminated OR truncated) OVER steps AS after_end,
        CASE
            WHEN lead(step_index) OVER steps = step_index + 1 THEN lead(observation) OVER steps
            WHEN terminated THEN observation
        END AS following
    FROM counted
    WINDOW steps AS (PARTITION BY episode ORDER BY step_index, place)
)
SELECT
    * EXCLUDE (following) REPLACE (
        coalesce(transition_id, place) AS transition_id,
        coalesce(next_observation, following)::FLOAT[] AS next_observation,
        observation::FLOAT[] AS observation,
        TRY_CAST(action AS SMALLINT) AS action,
        reward::FLOAT AS reward,
        coalesce(zone, 'elsewhere') AS zone,
        coalesce(behaviour_policy, 'unknown') AS behaviour_policy,
        coalesce(stamp_ns, 0) AS stamp_ns
    ),
    coalesce(TRY_CAST(action AS SMALLINT) = action AND action >= 0, false) AS discrete,
    'table' AS recording_id,
    episode::VARCHAR AS episode_id,
    condition AS primary_condition,
    CASE WHEN condition = 'nominal' THEN []::VARCHAR[] WHEN condition IS NOT NULL THEN [condition] END
        AS conditions,
    0.0 AS pose_x_m,
    0.0 AS pose_y_m,
    'table-' || size AS task_hash
FROM ordered;
