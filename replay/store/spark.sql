-- The views of views.sql in Spark's SQL, by the same names and columns, over stored_transitions and
-- stored_recordings. A test holds that both give the same rows. One statement ends with a semicolon
-- at the end of a line, and no other line does.

CREATE OR REPLACE TEMPORARY VIEW recordings AS
SELECT stored_recordings.*
FROM stored_recordings
LEFT SEMI JOIN stored_transitions ON stored_recordings.ingest_id = stored_transitions.ingest_id;

CREATE OR REPLACE TEMPORARY VIEW transitions AS
SELECT
    stored_transitions.*,
    stored_transitions.stamp_ns + coalesce(offsets.clock_offset_ns, 0) AS logged_ns
FROM stored_transitions
JOIN (SELECT ingest_id AS of_ingest, clock_offset_ns FROM stored_recordings) AS offsets
    ON stored_transitions.ingest_id = offsets.of_ingest;

CREATE OR REPLACE TEMPORARY VIEW actions AS
SELECT
    task_hash,
    CAST(pos AS SMALLINT) AS action,
    command[0] AS speed_mps,
    command[1] AS yaw_rate_radps
FROM (
    SELECT task_hash, posexplode(commands) AS (pos, command)
    FROM (
        SELECT
            task_hash,
            from_json(get_json_object(task_json, '$.actions'), 'array<array<double>>') AS commands
        FROM (SELECT DISTINCT task_hash, task_json FROM recordings)
    )
);

CREATE OR REPLACE TEMPORARY VIEW conditions AS
WITH newest AS (
    SELECT labels_version, conditions_json
    FROM recordings
    ORDER BY ingested_at DESC, ingest_id
    LIMIT 1
), specs AS (
    SELECT
        labels_version,
        explode(
            from_json(
                conditions_json, 'array<struct<name:string,timing:string,priority:int,sql:string>>'
            )
        ) AS spec
    FROM newest
)
SELECT
    spec.name AS condition,
    spec.timing AS timing,
    spec.priority AS priority,
    spec.sql AS sql,
    labels_version
FROM specs
UNION ALL
SELECT 'nominal', 'pre', 1000, 'none of the others', labels_version FROM newest;

CREATE OR REPLACE TEMPORARY VIEW episodes AS
WITH tasks AS (
    SELECT DISTINCT
        task_hash AS of_task,
        CAST(get_json_object(task_json, '$.rewards.goal') AS DOUBLE) AS goal_reward,
        get_json_object(task_json, '$.goal') = 'route' AS has_goal
    FROM recordings
), steps AS (
    SELECT
        *,
        row_number() OVER (PARTITION BY episode_id ORDER BY step_index) > 1
        AND NOT (
            behaviour_policy <=> lag(behaviour_policy) OVER (
                PARTITION BY episode_id ORDER BY step_index
            )
        ) AS handover
    FROM transitions
    LEFT JOIN tasks ON transitions.task_hash = tasks.of_task
)
SELECT
    recording_id,
    episode_id,
    any_value(episode_index) AS episode_index,
    any_value(task_hash) AS task_hash,
    min(stamp_ns) AS start_ns,
    max(stamp_ns) AS end_ns,
    count(*) AS steps,
    max(step_index) - min(step_index) + 1 - count(*) AS missing_steps,
    (max(stamp_ns) - min(stamp_ns)) / 1e9 AS duration_s,
    sum(reward) AS return,
    CASE
        WHEN bool_or(terminated) THEN 'terminated'
        WHEN bool_or(truncated) THEN 'truncated'
        ELSE 'open'
    END AS ended,
    CASE WHEN any_value(has_goal)
        THEN bool_or(terminated AND reward > goal_reward / 2)
    END AS success,
    sum(progress_m) AS progress_m,
    count(*) FILTER (WHERE bumped) AS bumped_steps,
    min(clearance_m) AS clearance_min_m,
    sort_array(array_distinct(flatten(collect_list(conditions)))) AS conditions,
    sort_array(collect_set(behaviour_policy)) AS behaviour_policies,
    min_by(behaviour_policy, step_index) AS first_policy,
    count(*) FILTER (WHERE handover) AS handovers,
    sort_array(collect_set(zone)) AS zones
FROM steps
GROUP BY recording_id, episode_id;

CREATE OR REPLACE TEMPORARY VIEW coverage AS
WITH cells AS (
    SELECT
        condition,
        action,
        zone,
        behaviour_policy,
        count(*) AS rows,
        count(DISTINCT transitions.episode_id) AS episodes,
        avg(reward) AS reward_mean,
        avg(CAST(terminated AS INT)) AS terminal_fraction,
        count(DISTINCT CASE WHEN success THEN transitions.episode_id END) AS succeeded,
        count(DISTINCT CASE WHEN success IS NOT NULL THEN transitions.episode_id END) AS judged
    FROM transitions
    JOIN (SELECT episode_id AS of_episode, success FROM episodes) AS outcomes
        ON transitions.episode_id = outcomes.of_episode
    GROUP BY condition, action, zone, behaviour_policy
)
SELECT
    condition,
    action,
    zone,
    behaviour_policy,
    rows,
    rows / sum(rows) OVER () AS share,
    episodes,
    reward_mean,
    terminal_fraction,
    succeeded / nullif(judged, 0) AS success_share
FROM cells
ORDER BY condition, action, zone, behaviour_policy;

CREATE OR REPLACE TEMPORARY VIEW coverage_by_condition AS
WITH seen AS (
    SELECT
        condition AS seen_condition,
        count(*) AS rows,
        count(DISTINCT recording_id) AS recordings,
        count(DISTINCT action) AS actions,
        count(DISTINCT zone) AS zones,
        sort_array(collect_set(behaviour_policy)) AS behaviour_policies,
        avg(reward) AS reward_mean,
        avg(CAST(terminated AS INT)) AS terminal_fraction
    FROM transitions
    GROUP BY condition
), parts AS (
    SELECT condition, episode_id, count(*) AS n FROM transitions GROUP BY condition, episode_id
), by_episode AS (
    SELECT
        condition AS part_condition,
        count(*) AS episodes,
        sum(n) * sum(n) / sum(n * n) AS effective_episodes,
        avg(CAST(success AS INT)) AS success_share,
        avg(return) AS return_mean
    FROM parts
    JOIN (SELECT episode_id AS of_episode, success, return FROM episodes) AS outcomes
        ON parts.episode_id = outcomes.of_episode
    GROUP BY condition
), named AS (
    SELECT condition, timing FROM conditions
    UNION ALL
    SELECT seen_condition, CAST(NULL AS STRING)
    FROM seen
    LEFT ANTI JOIN conditions ON seen.seen_condition = conditions.condition
)
SELECT
    condition,
    timing,
    coalesce(rows, 0) AS rows,
    coalesce(rows, 0) / nullif(sum(rows) OVER (), 0) AS share,
    coalesce(episodes, 0) AS episodes,
    coalesce(effective_episodes, 0) AS effective_episodes,
    success_share,
    return_mean,
    reward_mean,
    terminal_fraction,
    coalesce(recordings, 0) AS recordings,
    coalesce(actions, 0) AS actions,
    coalesce(zones, 0) AS zones,
    coalesce(behaviour_policies, CAST(array() AS ARRAY<STRING>)) AS behaviour_policies
FROM named
LEFT JOIN seen ON named.condition = seen.seen_condition
LEFT JOIN by_episode ON named.condition = by_episode.part_condition
ORDER BY rows DESC, condition;

CREATE OR REPLACE TEMPORARY VIEW coverage_by_perturbation AS
WITH cells AS (
    SELECT
        perturbation,
        count(*) AS rows,
        count(DISTINCT transitions.episode_id) AS episodes,
        count(DISTINCT transitions.recording_id) AS recordings,
        sort_array(collect_set(condition)) AS conditions,
        avg(reward) AS reward_mean,
        count(DISTINCT CASE WHEN success THEN transitions.episode_id END) AS succeeded,
        count(DISTINCT CASE WHEN success IS NOT NULL THEN transitions.episode_id END) AS judged
    FROM transitions
    JOIN (SELECT episode_id AS of_episode, success FROM episodes) AS outcomes
        ON transitions.episode_id = outcomes.of_episode
    GROUP BY perturbation
)
SELECT
    perturbation,
    rows,
    rows / sum(rows) OVER () AS share,
    episodes,
    recordings,
    conditions,
    reward_mean,
    succeeded / nullif(judged, 0) AS success_share
FROM cells
ORDER BY rows DESC, perturbation NULLS LAST;

CREATE OR REPLACE TEMPORARY VIEW perturbation_ranges AS
WITH entries AS (
    SELECT perturbation, episode_id, explode(perturbation_values) AS (field, value)
    FROM transitions
)
SELECT
    perturbation,
    field,
    count(*) AS rows,
    count(DISTINCT episode_id) AS episodes,
    min(value) AS value_min,
    avg(value) AS value_mean,
    max(value) AS value_max
FROM entries
GROUP BY perturbation, field
ORDER BY perturbation NULLS LAST, field;

CREATE OR REPLACE TEMPORARY VIEW missing_cells AS
WITH names AS (
    SELECT condition AS of_condition FROM conditions
    UNION
    SELECT condition FROM transitions
), possible AS (
    SELECT of_condition, of_action, speed_mps, yaw_rate_radps
    FROM names
    CROSS JOIN (SELECT DISTINCT action AS of_action, speed_mps, yaw_rate_radps FROM actions)
), seen AS (
    SELECT DISTINCT condition, action FROM transitions
)
SELECT of_condition AS condition, of_action AS action, speed_mps, yaw_rate_radps
FROM possible
LEFT ANTI JOIN seen
    ON possible.of_condition = seen.condition AND possible.of_action = seen.action
ORDER BY condition, action;

CREATE OR REPLACE TEMPORARY VIEW reward_mix AS
SELECT
    condition,
    count(*) AS rows,
    avg(reward) AS reward_mean,
    min(reward) AS reward_min,
    percentile(reward, 0.5) AS reward_median,
    max(reward) AS reward_max,
    avg(CAST(reward > 0 AS INT)) AS positive_share,
    avg(CAST(reward < -0.5 AS INT)) AS penalty_share,
    avg(CAST(terminated AS INT)) AS terminal_fraction,
    avg(CAST(truncated AS INT)) AS truncated_fraction
FROM transitions
GROUP BY condition
ORDER BY rows DESC, condition;

CREATE OR REPLACE TEMPORARY VIEW ages AS
SELECT
    condition,
    count(*) AS rows,
    timestamp_micros(CAST(min(logged_ns) DIV 1000 AS BIGINT)) AS oldest,
    timestamp_micros(CAST(max(logged_ns) DIV 1000 AS BIGINT)) AS newest,
    (unix_micros(now()) - max(logged_ns) / 1000) / 86400e6 AS age_min_days,
    (unix_micros(now()) - percentile_disc(0.5) WITHIN GROUP (ORDER BY logged_ns) / 1000) / 86400e6
        AS age_median_days,
    (unix_micros(now()) - min(logged_ns) / 1000) / 86400e6 AS age_max_days
FROM transitions
GROUP BY condition
ORDER BY rows DESC, condition;

CREATE OR REPLACE TEMPORARY VIEW label_overlap AS
WITH held AS (
    SELECT transition_id, explode(conditions) AS condition FROM transitions
), counts AS (
    SELECT condition AS counted, count(*) AS n FROM held GROUP BY condition
), pairs AS (
    SELECT a.condition AS condition, b.condition AS other, count(*) AS rows
    FROM held AS a
    JOIN held AS b ON a.transition_id = b.transition_id AND a.condition <> b.condition
    GROUP BY a.condition, b.condition
)
SELECT condition, other, rows, rows / n AS share
FROM pairs
JOIN counts ON pairs.condition = counts.counted
ORDER BY condition, other;

CREATE OR REPLACE TEMPORARY VIEW versions AS
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

CREATE OR REPLACE TEMPORARY VIEW drops AS
SELECT recording_id, source_file, dropped.reason AS reason, dropped.count AS count
FROM (SELECT recording_id, source_file, explode(drops) AS dropped FROM recordings)
ORDER BY recording_id, source_file, reason;

CREATE OR REPLACE TEMPORARY VIEW label_scores AS
SELECT
    recording_id,
    score.condition AS condition,
    score.precision AS precision,
    score.recall AS recall,
    score.labelled AS labelled,
    score.support AS support
FROM (SELECT recording_id, explode(label_scores) AS score FROM recordings)
ORDER BY recording_id, condition;

CREATE OR REPLACE TEMPORARY VIEW topics AS
SELECT
    recording_id,
    topic.topic AS topic,
    topic.type AS type,
    topic.expected AS expected,
    topic.decoded AS decoded,
    topic.skipped AS skipped,
    topic.reason AS reason
FROM (SELECT recording_id, explode(topics) AS topic FROM recordings)
ORDER BY recording_id, topic;
