-- Events: each run of steps at which a condition holds, and how it ended.
--
-- An event is a maximal run of consecutive steps of one episode at which a condition holds, whatever else
-- holds there. Its outcome is `recovered` if a later step of the episode is nominal (no condition holds) or
-- the episode reached its goal. Otherwise it is `open` if the episode lasts to the end of its recording (or
-- of its rows in the store), and `not recovered` if the episode ended before.

-- The event of each row and condition that holds in it: joins `transitions` and `events`.
CREATE OR REPLACE VIEW event_rows AS
SELECT
    transition_id,
    condition,
    episode_id || '/' || condition || '/' || CAST(onset_step AS VARCHAR) AS event_id
FROM (
    SELECT
        transition_id,
        episode_id,
        condition,
        min(step_index) OVER (PARTITION BY episode_id, condition, run) AS onset_step
    FROM (
        SELECT
            *,
            step_index - row_number() OVER (PARTITION BY episode_id, condition ORDER BY step_index) AS run
        FROM (
            SELECT transition_id, episode_id, step_index, unnest(conditions) AS condition
            FROM transitions
        )
    )
);

CREATE OR REPLACE VIEW events AS
WITH steps AS (
    SELECT
        episode_id,
        step_index,
        stamp_ns,
        stamp_time,
        logged_time,
        zone,
        behaviour_policy,
        clearance_m,
        bumped,
        conditions,
        lag(behaviour_policy) OVER (PARTITION BY episode_id ORDER BY step_index) AS before,
        lead(behaviour_policy) OVER (PARTITION BY episode_id ORDER BY step_index) AS after,
        lead(step_index) OVER (PARTITION BY episode_id ORDER BY step_index) AS next_step,
        lead(stamp_ns) OVER (PARTITION BY episode_id ORDER BY step_index) AS next_ns,
        min(CASE WHEN len(conditions) = 0 THEN stamp_ns END) OVER (
            PARTITION BY episode_id ORDER BY step_index
            ROWS BETWEEN 1 FOLLOWING AND UNBOUNDED FOLLOWING
        ) AS nominal_ns
    FROM transitions
), held AS (
    SELECT
        *,
        step_index - row_number() OVER (PARTITION BY episode_id, condition ORDER BY step_index) AS run
    FROM (SELECT *, unnest(conditions) AS condition FROM steps)
), runs AS (
    SELECT
        episode_id,
        condition,
        min(step_index) AS onset_step,
        max(step_index) AS end_step,
        count(*) AS steps,
        min(stamp_ns) AS onset_ns,
        max(stamp_ns) AS end_ns,
        min(stamp_time) AS onset_time,
        max(stamp_time) AS end_time,
        min(logged_time) AS logged_onset_time,
        max(logged_time) AS logged_end_time,
        arg_min(zone, step_index) AS zone,
        arg_min(behaviour_policy, step_index) AS behaviour_policy,
        arg_min(coalesce(before, behaviour_policy), step_index) AS policy_before,
        arg_max(coalesce(after, behaviour_policy), step_index) AS policy_after,
        min(clearance_m) AS clearance_min_m,
        bool_or(bumped) AS bumped,
        CASE WHEN max(next_step) = max(step_index) + 1 THEN max(next_ns) END AS next_ns,
        min(nominal_ns) AS nominal_ns
    FROM held
    GROUP BY episode_id, condition, run
), of_episode AS (
    SELECT
        recording_id,
        episode_id,
        ended,
        ended_by,
        robot,
        site,
        firmware,
        map,
        shift,
        tags,
        episode_end_ns,
        recording_end_ns,
        CAST(period_s * 1e9 AS BIGINT) AS period_ns
    FROM (SELECT recording_id, episode_id, ended, ended_by, end_ns AS episode_end_ns FROM episodes)
    JOIN (
        SELECT
            recording_id,
            robot,
            site,
            firmware,
            map,
            shift,
            tags,
            end_stamp_ns AS recording_end_ns,
            CAST(json_extract_string(task_json, '$.control_period_s') AS DOUBLE) AS period_s
        FROM recordings
    ) USING (recording_id)
), judged AS (
    SELECT
        *,
        coalesce(next_ns, end_ns + period_ns) AS over_ns,
        coalesce(nominal_ns, CASE WHEN ended_by = 'goal' THEN episode_end_ns + period_ns END) AS recovered_ns,
        CASE
            WHEN nominal_ns IS NOT NULL OR ended_by = 'goal' THEN 'recovered'
            WHEN ended = 'open' THEN 'open'
            WHEN ended = 'truncated' AND episode_end_ns + 2 * period_ns > recording_end_ns THEN 'open'
            ELSE 'not recovered'
        END AS outcome
    FROM runs
    JOIN of_episode USING (episode_id)
)
SELECT
    episode_id || '/' || condition || '/' || CAST(onset_step AS VARCHAR) AS event_id,
    condition,
    recording_id,
    episode_id,
    robot,
    site,
    firmware,
    map,
    shift,
    tags,
    zone,
    onset_step,
    end_step,
    steps,
    onset_ns,
    end_ns,
    onset_time,
    end_time,
    logged_onset_time,
    logged_end_time,
    (over_ns - onset_ns) / 1e9 AS duration_s,
    behaviour_policy,
    policy_before,
    policy_after,
    clearance_min_m,
    bumped OR (coalesce(ended_by, '') = 'bump' AND end_ns = episode_end_ns) AS bumped,
    outcome,
    CASE WHEN outcome <> 'open' THEN outcome = 'recovered' END AS recovered,
    (recovered_ns - onset_ns) / 1e9 AS recovered_after_s
FROM judged;
