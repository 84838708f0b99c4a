-- Faults for test_audit.py, each planted in two clean recordings, 1 and 2, of 120 episodes.
-- A header names the audit, the rows that it then finds, and a part of the first of them.

-- rare_condition 1 {"condition": "wheel_slip", "rows_held": 0}
DELETE FROM transitions WHERE list_contains(conditions, 'wheel_slip');

-- few_effective_episodes 1 {"condition": "wheel_slip", "episodes_held": 1}
DELETE FROM transitions WHERE list_contains(conditions, 'wheel_slip') AND episode_id <>
    (SELECT min(episode_id) FROM transitions WHERE list_contains(conditions, 'wheel_slip'));

-- missing_cells 1 {"condition": "recovery", "action_name": "back 0.4", "rows": 0}
DELETE FROM transitions WHERE condition = 'recovery' AND action = 4;

-- thin_perturbation 1 {"condition": "wheel_slip", "rows": 0}
UPDATE transitions SET perturbation = if(list_contains(conditions, 'wheel_slip'), NULL, 'wet');

-- stale_data 1 {"condition": "wheel_slip"}
UPDATE transitions SET stamp_ns = stamp_ns - 400 * 86_400_000_000_000
WHERE list_contains(conditions, 'wheel_slip');

-- single_behaviour_policy 1 {"condition": "wheel_slip"}
UPDATE transitions SET behaviour_policy = 'planner' WHERE condition = 'wheel_slip';

-- null_values 1 {"transition_id": 33554449}
UPDATE transitions SET reward = NULL WHERE transition_id = 33554449;

-- null_values 1 {"transition_id": 33554449}
UPDATE transitions SET next_observation = [NULL] || observation[2:] WHERE transition_id = 33554449;

-- non_finite_values 2 {"transition_id": 33554437}
UPDATE transitions SET observation = ['nan'::FLOAT] || observation[2:]
WHERE transition_id = 33554437;
UPDATE transitions SET observation = observation[:-2] || ['inf'::FLOAT]
WHERE transition_id = 33554438;

-- duplicate_transitions 2 {"copies": 2}
INSERT INTO transitions FROM transitions ORDER BY transition_id LIMIT 2;

-- several_tasks 2 {"recordings": 1}
UPDATE transitions SET task_hash = 'other' WHERE number(recording_id) = 2;
UPDATE recordings SET task_hash = 'other' WHERE number(recording_id) = 2;

-- stale_labels 1 {"recording_id": "0000000000000002"}
UPDATE recordings SET labels_version = 'old', ingested_at = '2025-01-01'
WHERE number(recording_id) = 2;

-- stale_labels 1 {"recording_id": "0000000000000002"}
-- A newer ingest is of another robot's profile.
UPDATE recordings SET labels_version = 'old', ingested_at = '2025-01-01'
WHERE number(recording_id) = 2;
INSERT INTO recordings SELECT * REPLACE ('3' AS recording_id, 'c' AS ingest_id,
    'other' AS profile, TIMESTAMPTZ '2026-02-01' AS ingested_at)
FROM recordings WHERE number(recording_id) = 1;

-- label_quality 1 {"condition": "wheel_slip", "precision": 0.5}
UPDATE recordings SET label_scores = if(number(recording_id) = 1, [{condition: 'wheel_slip',
    precision: 0.5, recall: 0.9, support: 30, labelled: 50}], []);

-- uncertain_labels 1 {"condition": "wheel_slip"}
UPDATE transitions SET uncertain = if(condition = 'wheel_slip', ['wheel_slip'], []);

-- stratum_of_failures 1 {"condition": "wheel_slip", "success_share": 0.0}
UPDATE transitions SET terminated = false WHERE episode_id IN
    (SELECT episode_id FROM transitions WHERE list_contains(conditions, 'wheel_slip'));

-- unsafe_data 1 {"behaviour_policy": "operator"}
UPDATE transitions SET bumped = true
WHERE behaviour_policy = 'operator' AND transition_id % 10 = 0;

-- dropped_ticks 1 {"dropped": 2000}
UPDATE recordings SET drops = [{reason: 'stale scan', count: 2000}]
WHERE number(recording_id) = 1;

-- odometry_as_command 1 {"instead": "odometry"}
UPDATE recordings SET stand_ins = [{input: 'command', instead: 'odometry'}]
WHERE number(recording_id) = 1;

-- speeds_from_poses 1 {"instead": "speeds from poses"}
UPDATE recordings SET stand_ins = [{input: 'wheels', instead: 'speeds from poses'}]
WHERE number(recording_id) = 1;

-- goals_by_hindsight 1 {"recording_id": "0000000000000001"}
UPDATE transitions SET goal_source = if(number(recording_id) = 1, 'hindsight', NULL);

-- mixed_goal_sources 1 {"logged_episodes": 120}
UPDATE transitions SET goal_source = 'hindsight' WHERE number(recording_id) = 1;

-- contradictions 1 {"topic": "/odom", "remedy": "chrony"}
UPDATE recordings SET findings = [
    {kind: 'order', topic: '/odom', what: 'too early', steps: 9, cause: 'clock',
    remedy: 'chrony', repaired: repaired} FOR repaired IN [true, false]
] WHERE number(recording_id) = 1;

-- unknown_conditions 1 {"condition": "recovery", "recordings": 1}
UPDATE recordings SET unknown_conditions = [{condition: 'recovery', kind: 'outcome',
    signals: ['clearance_m'], because: 'no lidar'}] WHERE number(recording_id) = 1;

-- far_actions 1 {"behaviour_policy": "operator", "far_share": 1.0}
UPDATE transitions SET action_residual = if(behaviour_policy = 'operator', 0.4, 0);

-- one_action 1 {"recording_id": "0000000000000001", "action": 3, "share": 1.0}
UPDATE transitions SET action = 3 WHERE number(recording_id) = 1;

-- same_drive 1 {"same_as": "0000000000000002", "later_s": 33000000.0}
-- The second recording is the first one, later, its poses in another frame.
DELETE FROM transitions WHERE number(recording_id) = 2;
UPDATE transitions SET wheel_speed_mps = 0.1 + transition_id % 9001 / 1e4;
INSERT INTO transitions SELECT * REPLACE ('0000000000000002' AS recording_id,
    stamp_ns + 33_000_000_000_000_000 AS stamp_ns, pose_x_m + 4 AS pose_x_m) FROM transitions;

-- overlapping_recordings 1 {"both_s": 20.0}
UPDATE recordings SET start_stamp_ns = number(recording_id) * 40_000_000_000,
    end_stamp_ns = number(recording_id) * 40_000_000_000 + 60_000_000_000;

-- repeated_steps 1 {"same_as_file": "logs/part.mcap", "rows": 60}
INSERT INTO recordings SELECT * REPLACE ('9' AS recording_id, '9-a' AS ingest_id,
    'logs/part.mcap' AS source_file) FROM recordings WHERE number(recording_id) = 1;
INSERT INTO transitions SELECT * REPLACE ('9' AS recording_id, '9-a' AS ingest_id,
    'logs/part.mcap' AS source_file, transition_id + (8 << 25) AS transition_id)
FROM transitions WHERE transition_id BETWEEN (1 << 25) + 20 AND (1 << 25) + 79;

-- signal_drift 2 {"signal": "odometry_scale", "scope": "alone"}
-- Wheels of the second recording, a week later, report too much.
UPDATE transitions SET
    stamp_ns = stamp_ns + if(number(recording_id) = 2, 7 * 86_400_000_000_000, 0),
    wheel_speed_mps = 0.8,
    wheel_yaw_rate_radps = 0,
    localised_speed_mps = if(number(recording_id) = 2, 0.72, 0.8)
        + 0.02 * sin(hash(transition_id) % 1000);
UPDATE transitions SET pose_stamp_ns = stamp_ns;

-- untagged_recordings 1 {"recording_id": "0000000000000002", "untold": "site"}
UPDATE recordings SET tags =
    if(number(recording_id) = 1, MAP {'robot': 'a', 'site': 'o'}, MAP {'robot': 'b'});

-- single_robot 1 {"condition": "wheel_slip", "robot": "a"}
UPDATE recordings SET tags = MAP {'robot': if(number(recording_id) = 1, 'a', 'b')};
DELETE FROM transitions WHERE number(recording_id) = 2 AND condition = 'wheel_slip';

-- policy_bias 1 {"behaviour_policy": "operator"}
-- The operator drives nominal episodes, in which all arrive.
UPDATE transitions SET
    true_condition = if(episode_index % 3 = 0, 'wheel_slip', 'nominal'),
    behaviour_policy = if(episode_index % 6 = 4, 'operator', 'planner'),
    terminated = (terminated OR truncated) AND episode_index % 6 <> 3,
    truncated = (terminated OR truncated) AND episode_index % 6 = 3,
    reward = if((terminated OR truncated) AND episode_index % 6 <> 3, 5, -0.1);

-- policy_bias 1 {"behaviour_policy": "operator"}
-- It also drove some episodes on a slippery floor, and failed there.
UPDATE transitions SET
    true_condition = if(episode_index % 3 = 0, 'wheel_slip', 'nominal'),
    behaviour_policy =
        if(episode_index % 6 = 4 OR episode_index % 30 = 3, 'operator', 'planner'),
    terminated = (terminated OR truncated) AND episode_index % 6 <> 3,
    truncated = (terminated OR truncated) AND episode_index % 6 = 3,
    reward = if((terminated OR truncated) AND episode_index % 6 <> 3, 5, -0.1);

-- reward_order 1 {"driver": "operator 1", "other": "planner 1"}
-- The planner bumps in half of its episodes and still earns more.
UPDATE transitions SET
    true_condition = 'nominal',
    bumped = false,
    behaviour_policy = if(episode_index % 2 = 0, 'operator', 'planner'),
    terminated = terminated OR truncated,
    truncated = false,
    reward = CASE
        WHEN (terminated OR truncated) AND episode_index % 4 <> 3 THEN 5
        WHEN episode_index % 2 = 0 THEN -0.1
        ELSE 0.5
    END;

-- no_action_probability 2 {}
UPDATE transitions SET action_probability = NULL;
