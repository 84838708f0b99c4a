-- The common views from the summaries in manifests (`stored_summaries`, made by ingest/store/summary.sql). They
-- replace those of views.sql and macros.sql, which scan the rows, if every recording of the store has a summary.

CREATE OR REPLACE VIEW episodes AS
SELECT
    recording_id,
    one.episode_id AS episode_id,
    one.episode_index AS episode_index,
    task_hash,
    one.start_ns AS start_ns,
    one.end_ns AS end_ns,
    make_timestamp(one.start_ns // 1000) AS start_time,
    make_timestamp(one.end_ns // 1000) AS end_time,
    make_timestamp((one.start_ns + coalesce(clock_offset_ns, 0)) // 1000) AS logged_start_time,
    make_timestamp((one.end_ns + coalesce(clock_offset_ns, 0)) // 1000) AS logged_end_time,
    one.steps AS steps,
    one.missing_steps AS missing_steps,
    (one.end_ns - one.start_ns) / 1e9 AS duration_s,
    one.return AS return,
    one.ended AS ended,
    one.ended_by AS ended_by,
    one.goal_source AS goal_source,
    one.success AS success,
    one.progress_m AS progress_m,
    one.bumped_steps AS bumped_steps,
    one.clearance_min_m AS clearance_min_m,
    one.conditions AS conditions,
    one.behaviour_policies AS behaviour_policies,
    one.first_policy AS first_policy,
    one.handovers AS handovers,
    one.zones AS zones,
    robot,
    site,
    firmware,
    map,
    shift,
    tags
FROM (SELECT ingest_id, unnest(episode_rows) AS one FROM stored_summaries)
JOIN recordings USING (ingest_id);

CREATE OR REPLACE VIEW coverage AS
SELECT
    cell.condition AS condition,
    cell.action AS action,
    any_value(action_name) AS action_name,
    cell.zone AS zone,
    cell.behaviour_policy AS behaviour_policy,
    CAST(sum(cell.rows_held) AS BIGINT) AS rows_held,
    sum(cell.rows_held) / sum(sum(cell.primary_rows)) OVER () AS held_share,
    CAST(sum(cell.episodes_held) AS BIGINT) AS episodes_held,
    sum(cell.reward_sum) / nullif(sum(cell.rewards), 0) AS reward_mean,
    sum(cell.terminated) / nullif(sum(cell.known_ends), 0) AS terminal_fraction,
    sum(cell.successes) / nullif(sum(cell.goal_episodes), 0) AS success_share,
    CAST(sum(cell.primary_rows) AS BIGINT) AS primary_rows,
    sum(cell.primary_rows) / sum(sum(cell.primary_rows)) OVER () AS primary_share
FROM (SELECT ingest_id, unnest(cells) AS cell FROM stored_summaries)
SEMI JOIN recordings USING (ingest_id)
LEFT JOIN (
    SELECT action, CASE WHEN count(DISTINCT name) = 1 THEN min(name) END AS action_name
    FROM actions
    GROUP BY action
) AS named ON named.action = cell.action
GROUP BY ALL
UNION ALL
SELECT condition, NULL, NULL, NULL, NULL, NULL, NULL, NULL, NULL, NULL, NULL, NULL, NULL
FROM untold_conditions
WHERE kind = 'outcome' AND condition NOT IN (
    SELECT cell.condition
    FROM (SELECT ingest_id, unnest(cells) AS cell FROM stored_summaries)
    SEMI JOIN recordings USING (ingest_id)
)
ORDER BY condition, action, zone, behaviour_policy;

CREATE OR REPLACE VIEW coverage_by_condition AS
WITH seen AS (
    SELECT
        cell.condition AS condition,
        CAST(sum(cell.rows_held) AS BIGINT) AS rows_held,
        count(DISTINCT ingest_id) AS recordings,
        count(DISTINCT cell.action) AS actions,
        count(DISTINCT cell.zone) AS zones,
        list_sort(list(DISTINCT cell.behaviour_policy)) AS behaviour_policies,
        sum(cell.reward_sum) / nullif(sum(cell.rewards), 0) AS reward_mean,
        sum(cell.terminated) / nullif(sum(cell.known_ends), 0) AS terminal_fraction,
        CAST(sum(cell.primary_rows) AS BIGINT) AS primary_rows
    FROM (SELECT ingest_id, unnest(cells) AS cell FROM stored_summaries)
    SEMI JOIN recordings USING (ingest_id)
    GROUP BY ALL
), by_episode AS (
    SELECT
        part.condition AS condition,
        CAST(sum(part.episodes_held) AS BIGINT) AS episodes_held,
        CAST(sum(part.rows_held) AS DOUBLE) * sum(part.rows_held) / sum(part.squared_rows)
            AS effective_episodes,
        sum(part.successes) / nullif(sum(part.goal_episodes), 0) AS success_share,
        sum(part.return_sum) / nullif(sum(part.returns), 0) AS return_mean
    FROM (SELECT ingest_id, unnest(condition_episodes) AS part FROM stored_summaries)
    SEMI JOIN recordings USING (ingest_id)
    GROUP BY ALL
)
-- include: coverage_columns.sql
;

CREATE OR REPLACE VIEW recording_cells AS
SELECT
    recording_id,
    cell.condition AS condition,
    cell.action AS action,
    cell.behaviour_policy AS behaviour_policy,
    CAST(sum(cell.primary_rows) AS BIGINT) AS rows
FROM (SELECT ingest_id, unnest(cells) AS cell FROM stored_summaries)
JOIN (SELECT ingest_id, recording_id FROM recordings) USING (ingest_id)
WHERE cell.primary_rows > 0
GROUP BY ALL;

CREATE OR REPLACE VIEW recording_conditions AS
SELECT
    recording_id,
    part.condition AS condition,
    part.primary_rows AS rows,
    part.primary_episodes AS episodes
FROM (SELECT ingest_id, unnest(condition_episodes) AS part FROM stored_summaries)
JOIN (SELECT ingest_id, recording_id FROM recordings) USING (ingest_id)
WHERE part.primary_rows > 0;

CREATE OR REPLACE VIEW measured_signals AS
SELECT
    recording_id,
    one.episode_id AS episode_id,
    one.signal AS signal,
    one.value AS value,
    one.steps AS steps
FROM (SELECT ingest_id, unnest(measured_signals) AS one FROM stored_summaries)
JOIN (SELECT ingest_id, recording_id FROM recordings) USING (ingest_id);

CREATE OR REPLACE VIEW zone_steps AS
SELECT
    recording_id,
    one.episode_id AS episode_id,
    one.zone AS zone,
    one.start_ns AS start_ns,
    one.steps AS steps
FROM (SELECT ingest_id, unnest(zone_steps) AS one FROM stored_summaries)
JOIN (SELECT ingest_id, recording_id FROM recordings) USING (ingest_id);

CREATE OR REPLACE VIEW condition_steps AS
SELECT
    recording_id,
    one.episode_id AS episode_id,
    one.zone AS zone,
    one.condition AS condition,
    one.steps AS steps,
    one.events AS events
FROM (SELECT ingest_id, unnest(condition_steps) AS one FROM stored_summaries)
JOIN (SELECT ingest_id, recording_id FROM recordings) USING (ingest_id);

CREATE OR REPLACE VIEW flawed_rows AS
SELECT
    one.transition_id AS transition_id,
    recording_id,
    one.episode_id AS episode_id,
    one.step_index AS step_index,
    one.is_null AS is_null,
    one.is_not_finite AS is_not_finite
FROM (SELECT ingest_id, unnest(flawed_rows) AS one FROM stored_summaries)
JOIN (SELECT ingest_id, recording_id FROM recordings) USING (ingest_id);

CREATE OR REPLACE MACRO cells_below(minimum) AS TABLE
WITH held AS (
    SELECT cell.condition AS condition, cell.action AS action, CAST(sum(cell.rows_held) AS BIGINT) AS rows
    FROM (SELECT ingest_id, unnest(cells) AS cell FROM stored_summaries)
    SEMI JOIN recordings USING (ingest_id)
    GROUP BY ALL
)
SELECT condition, action, action_name, speed_mps, yaw_rate_radps, coalesce(rows, 0) AS rows
FROM (
    SELECT condition FROM conditions
    UNION
    SELECT cell.condition
    FROM (SELECT ingest_id, unnest(cells) AS cell FROM stored_summaries)
    SEMI JOIN recordings USING (ingest_id)
)
CROSS JOIN (SELECT DISTINCT action, name AS action_name, speed_mps, yaw_rate_radps FROM actions)
LEFT JOIN held USING (condition, action)
ANTI JOIN untold_conditions USING (condition)
WHERE coalesce(rows, 0) < minimum
ORDER BY condition, action;

-- Rows are read only if they have a true condition; rows of a fleet's logs have none.
CREATE OR REPLACE MACRO episode_kinds(min_steps) AS TABLE
WITH told AS (
    SELECT DISTINCT episode_id FROM transitions WHERE true_condition IS NOT NULL
), held AS (
    SELECT episode_id, unnest(string_split(true_condition, ',')) AS kind, 1 AS steps
    FROM transitions
    WHERE true_condition IS NOT NULL AND true_condition <> 'nominal'
    UNION ALL
    SELECT episode_id, unnest(conditions), 1
    FROM transitions
    SEMI JOIN told USING (episode_id)
    WHERE true_condition IS NULL
    UNION ALL
    SELECT episode_id, condition, steps FROM condition_steps ANTI JOIN told USING (episode_id)
), longest AS (
    SELECT episode_id, first(kind ORDER BY steps DESC, kind) AS kind
    FROM (SELECT episode_id, kind, sum(steps) AS steps FROM held GROUP BY ALL HAVING sum(steps) >= min_steps)
    GROUP BY episode_id
)
SELECT episode_id, coalesce(kind, 'nominal') AS kind, success, return, first_policy
FROM episodes
LEFT JOIN longest USING (episode_id);

CREATE OR REPLACE VIEW missing_cells AS
SELECT condition, action, action_name, speed_mps, yaw_rate_radps FROM cells_below(1);
