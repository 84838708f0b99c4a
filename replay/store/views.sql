-- The views of a store, over its `recordings` and `transitions` (rows.sql).
-- columns.toml documents every column (those of `transitions` and `recordings`: ingest/task/schema.py), which
-- a test checks.

-- The discrete actions of each task, from the task in the manifests.
CREATE OR REPLACE VIEW actions AS
SELECT
    task_hash,
    action,
    speed_mps,
    yaw_rate_radps,
    -- The same name as in restock.ingest.task.task, e.g. drive 0.8 left 0.7.
    CASE
        WHEN speed_mps = 0 AND yaw_rate_radps = 0 THEN 'stop'
        WHEN speed_mps = 0 THEN concat('turn ', turn)
        WHEN yaw_rate_radps = 0 THEN drive
        ELSE concat(drive, ' ', turn)
    END AS name
FROM (
    SELECT
        *,
        concat(
            CASE WHEN speed_mps > 0 THEN 'drive ' ELSE 'back ' END,
            regexp_replace(CAST(round(abs(speed_mps), 3) AS VARCHAR), '[.]0$', '')
        ) AS drive,
        concat(
            CASE WHEN yaw_rate_radps > 0 THEN 'left ' ELSE 'right ' END,
            regexp_replace(CAST(round(abs(yaw_rate_radps), 3) AS VARCHAR), '[.]0$', '')
        ) AS turn
    FROM (
        SELECT
            task_hash,
            action,
            list_extract(list_extract(commands, action + 1), 1) AS speed_mps,
            list_extract(list_extract(commands, action + 1), 2) AS yaw_rate_radps
        FROM (
            SELECT task_hash, commands, CAST(position AS SMALLINT) AS action
            FROM (
                SELECT task_hash, commands, unnest(range(len(commands))) AS position
                FROM (
                    SELECT DISTINCT
                        task_hash,
                        from_json(
                            json_extract_string(task_json, '$.actions'), '[["DOUBLE"]]'
                        ) AS commands
                    FROM recordings
                )
            )
        )
    )
);

-- The conditions of the newest ingest, by which the store was labelled, and `nominal`: none of them holds.
CREATE OR REPLACE VIEW conditions AS
SELECT
    spec.name AS condition,
    spec.timing AS timing,
    spec.priority AS priority,
    spec.sql AS sql,
    labels_version
FROM (
    SELECT
        labels_version,
        unnest(from_json(
            conditions_json,
            '[{"name": "VARCHAR", "timing": "VARCHAR", "priority": "INTEGER", "sql": "VARCHAR"}]'
        )) AS spec
    FROM (SELECT * FROM recordings ORDER BY ingested_at DESC, ingest_id LIMIT 1)
)
UNION ALL
SELECT 'nominal', 'pre', 1000, 'none of the others', labels_version
FROM (SELECT * FROM recordings ORDER BY ingested_at DESC, ingest_id LIMIT 1);

-- Conditions (or exposures) that are unknown in a recording: its rows show neither that they hold nor that they
-- do not. One row per recording and condition.
CREATE OR REPLACE VIEW unknown_conditions AS
SELECT
    recording_id,
    source_file,
    transitions,
    unknown.condition AS condition,
    unknown.kind AS kind,
    unknown.signals AS signals,
    unknown.because AS because
FROM (
    SELECT recording_id, source_file, transitions, unnest(unknown_conditions) AS unknown
    FROM recordings
);

-- Conditions that are unknown in all recordings: their counts are null, not 0.
CREATE OR REPLACE VIEW untold_conditions AS
SELECT condition, kind
FROM (
    SELECT condition, kind, count(DISTINCT recording_id) AS recordings
    FROM unknown_conditions
    GROUP BY condition, kind
)
CROSS JOIN (SELECT count(*) AS all_recordings FROM recordings)
WHERE recordings = all_recordings;

-- Python replaces this view by measured values when a query names it (novelty.py). Elsewhere it is null.
CREATE OR REPLACE VIEW novelty AS
SELECT transition_id, CAST(NULL AS FLOAT) AS novelty, CAST(NULL AS BOOLEAN) AS novel
FROM transitions;

CREATE OR REPLACE VIEW episodes AS
SELECT *
FROM (
    SELECT
        recording_id,
        episode_id,
        any_value(episode_index) AS episode_index,
        any_value(task_hash) AS task_hash,
        min(stamp_ns) AS start_ns,
        max(stamp_ns) AS end_ns,
        min(stamp_time) AS start_time,
        max(stamp_time) AS end_time,
        min(logged_time) AS logged_start_time,
        max(logged_time) AS logged_end_time,
        count(*) AS steps,
        max(step_index) - min(step_index) + 1 - count(*) AS missing_steps,
        (max(stamp_ns) - min(stamp_ns)) / 1e9 AS duration_s,
        -- include: episode_columns.sql
    FROM (
        SELECT
            *,
            row_number() OVER (PARTITION BY episode_id ORDER BY step_index) > 1
            AND behaviour_policy IS DISTINCT FROM lag(behaviour_policy) OVER (
                PARTITION BY episode_id ORDER BY step_index
            ) AS handover
        FROM transitions
        LEFT JOIN (
            SELECT DISTINCT
                task_hash AS of_task,
                CAST(json_extract_string(task_json, '$.rewards.goal') AS DOUBLE) AS goal_reward,
                json_extract_string(task_json, '$.goal') = 'route' AS has_goal
            FROM recordings
        ) AS tasks ON transitions.task_hash = tasks.of_task
    )
    GROUP BY recording_id, episode_id
)
JOIN (SELECT recording_id, robot, site, firmware, map, shift, tags FROM recordings)
    USING (recording_id);

-- `transitions` with one row for each condition that holds in a transition, or one row, nominal, if none holds.
CREATE OR REPLACE VIEW held_conditions AS
SELECT *, unnest(conditions) AS condition
FROM transitions
UNION ALL
SELECT *, primary_condition AS condition
FROM transitions
WHERE coalesce(len(conditions), 0) < 1;

-- Each cell that was seen; missing_cells has the others, which GROUP BY cannot show. A condition that is unknown
-- in all recordings has one row of nulls.
CREATE OR REPLACE VIEW coverage AS
SELECT
    condition,
    action,
    any_value(action_name) AS action_name,
    zone,
    behaviour_policy,
    count(*) AS rows_held,
    count(*) / sum(count(*) FILTER (WHERE condition = primary_condition)) OVER () AS held_share,
    count(DISTINCT episode_id) AS episodes_held,
    avg(reward) AS reward_mean,
    avg(CAST(terminated AS INTEGER)) AS terminal_fraction,
    (count(DISTINCT episode_id) FILTER (WHERE success))
        / nullif(count(DISTINCT episode_id) FILTER (WHERE success IS NOT NULL), 0) AS success_share,
    count(*) FILTER (WHERE condition = primary_condition) AS primary_rows,
    (count(*) FILTER (WHERE condition = primary_condition))
        / sum(count(*) FILTER (WHERE condition = primary_condition)) OVER () AS primary_share
FROM held_conditions
JOIN (SELECT episode_id, success FROM episodes) USING (episode_id)
LEFT JOIN (
    SELECT action, CASE WHEN count(DISTINCT name) = 1 THEN min(name) END AS action_name
    FROM actions
    GROUP BY action
) USING (action)
GROUP BY condition, action, zone, behaviour_policy
UNION ALL
SELECT condition, NULL, NULL, NULL, NULL, NULL, NULL, NULL, NULL, NULL, NULL, NULL, NULL
FROM untold_conditions
WHERE kind = 'outcome' AND condition NOT IN (SELECT condition FROM held_conditions)
ORDER BY condition, action, zone, behaviour_policy;

-- One row per condition, including conditions never seen; nulls if it is unknown in all recordings.
CREATE OR REPLACE VIEW coverage_by_condition AS
WITH seen AS (
    SELECT
        condition,
        count(*) AS rows_held,
        count(DISTINCT recording_id) AS recordings,
        count(DISTINCT action) AS actions,
        count(DISTINCT zone) AS zones,
        list_sort(list(DISTINCT behaviour_policy)) AS behaviour_policies,
        avg(reward) AS reward_mean,
        avg(CAST(terminated AS INTEGER)) AS terminal_fraction,
        count(*) FILTER (WHERE condition = primary_condition) AS primary_rows
    FROM held_conditions
    GROUP BY condition
), by_episode AS (
    SELECT
        condition,
        count(*) AS episodes_held,
        sum(n) * sum(n) / sum(n * n) AS effective_episodes,
        avg(CAST(success AS INTEGER)) AS success_share,
        avg(return) AS return_mean
    FROM (
        SELECT condition, episode_id, count(*) AS n FROM held_conditions GROUP BY condition, episode_id
    )
    JOIN episodes USING (episode_id)
    GROUP BY condition
)
-- include: coverage_columns.sql
;

-- One row per perturbation of the twin; null: hardware, or a simulator that did not record it.
CREATE OR REPLACE VIEW coverage_by_perturbation AS
SELECT
    perturbation,
    count(*) AS rows,
    count(*) / sum(count(*)) OVER () AS share,
    count(DISTINCT episode_id) AS episodes,
    count(DISTINCT recording_id) AS recordings,
    list_sort(list_distinct(flatten(list(conditions)))) AS conditions,
    avg(reward) AS reward_mean,
    (count(DISTINCT episode_id) FILTER (WHERE success))
        / nullif(count(DISTINCT episode_id) FILTER (WHERE success IS NOT NULL), 0) AS success_share
FROM transitions
JOIN (SELECT episode_id, success FROM episodes) USING (episode_id)
GROUP BY perturbation
ORDER BY rows DESC, perturbation;

-- Range of each field of a perturbation, over the rows in which the field differed from the nominal twin.
CREATE OR REPLACE VIEW perturbation_ranges AS
SELECT
    perturbation,
    field,
    count(*) AS rows,
    count(DISTINCT episode_id) AS episodes,
    min(value) AS value_min,
    avg(value) AS value_mean,
    max(value) AS value_max
FROM (
    SELECT perturbation, episode_id, entry.key AS field, entry.value AS value
    FROM (
        SELECT perturbation, episode_id, unnest(map_entries(perturbation_values)) AS entry
        FROM transitions
    )
)
GROUP BY perturbation, field
ORDER BY perturbation, field;

-- Condition x action cells without a row in which the condition holds; cells_below(n) has those with fewer than n.
CREATE OR REPLACE VIEW missing_cells AS
SELECT condition, action, action_name, speed_mps, yaw_rate_radps
FROM (SELECT condition FROM conditions UNION SELECT condition FROM held_conditions)
CROSS JOIN (SELECT DISTINCT action, name AS action_name, speed_mps, yaw_rate_radps FROM actions)
ANTI JOIN (SELECT DISTINCT condition, action FROM held_conditions) USING (condition, action)
ANTI JOIN untold_conditions USING (condition)
ORDER BY condition, action;

CREATE OR REPLACE VIEW reward_mix AS
SELECT
    condition,
    count(*) AS rows_held,
    avg(reward) AS reward_mean,
    min(reward) AS reward_min,
    quantile_cont(reward, 0.5) AS reward_median,
    max(reward) AS reward_max,
    avg(CAST(reward > 0 AS INTEGER)) AS positive_share,
    avg(CAST(reward < -0.5 AS INTEGER)) AS penalty_share,
    avg(CAST(terminated AS INTEGER)) AS terminal_fraction,
    avg(CAST(truncated AS INTEGER)) AS truncated_fraction
FROM held_conditions
GROUP BY condition
ORDER BY rows_held DESC, condition;

-- Age of each condition's rows today; use ages_at(moment) for another day.
CREATE OR REPLACE VIEW ages AS
SELECT
    condition,
    count(*) AS rows_held,
    make_timestamp_ns(min(logged_ns)) AS oldest,
    make_timestamp_ns(max(logged_ns)) AS newest,
    (epoch_ns(now()) - max(logged_ns)) / 86400e9 AS age_min_days,
    (epoch_ns(now()) - quantile_disc(logged_ns, 0.5)) / 86400e9 AS age_median_days,
    (epoch_ns(now()) - min(logged_ns)) / 86400e9 AS age_max_days
FROM held_conditions
GROUP BY condition
ORDER BY rows_held DESC, condition;

-- Pairs of conditions that hold at the same time: a row can hold several.
CREATE OR REPLACE VIEW label_overlap AS
WITH held AS (SELECT transition_id, condition FROM held_conditions WHERE condition <> 'nominal'),
counts AS (SELECT condition, count(*) AS n FROM held GROUP BY condition)
SELECT
    a.condition AS condition,
    b.condition AS other,
    count(*) AS rows,
    count(*) / any_value(counts.n) AS share
FROM held AS a
JOIN held AS b ON a.transition_id = b.transition_id AND a.condition <> b.condition
JOIN counts ON counts.condition = a.condition
GROUP BY a.condition, b.condition
ORDER BY condition, other;

-- Definitions in use: more than one row means that rows were made or labelled in different ways.
CREATE OR REPLACE VIEW versions AS
SELECT
    task_hash,
    labels_version,
    profile_hash,
    restock_version,
    count(*) AS rows,
    count(DISTINCT recording_id) AS recordings
FROM transitions
GROUP BY task_hash, labels_version, profile_hash, restock_version
ORDER BY rows DESC;

-- Ticks that ingest left out, and why.
CREATE OR REPLACE VIEW drops AS
SELECT recording_id, source_file, dropped.reason AS reason, dropped.count AS count
FROM (SELECT recording_id, source_file, unnest(drops) AS dropped FROM recordings)
ORDER BY recording_id, source_file, reason, count;

-- Topics of each recording, with the numbers of expected and decoded messages.
CREATE OR REPLACE VIEW topics AS
SELECT
    recording_id,
    topic.topic AS topic,
    topic.type AS type,
    topic.expected AS expected,
    topic.decoded AS decoded,
    topic.skipped AS skipped,
    topic.reason AS reason
FROM (SELECT recording_id, unnest(topics) AS topic FROM recordings)
ORDER BY recording_id, topic;
