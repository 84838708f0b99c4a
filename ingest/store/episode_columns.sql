-- Columns of an episode, from its steps: rows of `transitions` with their task's `has_goal` and
-- `goal_reward`, and with `handover`. Included in two statements: the view that scans rows, and the
-- summary in a recording's manifest.
sum(reward) AS return,
CASE
    WHEN bool_or(terminated) THEN 'terminated'
    WHEN bool_or(truncated) THEN 'truncated'
    ELSE 'open'
END AS ended,
-- An episode ends by the goal's reward, or by a bump.
CASE
    WHEN any_value(has_goal) AND bool_or(terminated AND reward > goal_reward / 2) THEN 'goal'
    WHEN bool_or(terminated) THEN 'bump'
END AS ended_by,
CASE WHEN any_value(has_goal) THEN coalesce(any_value(goal_source), 'logged') END AS goal_source,
-- Goals set in hindsight are always reached, so they do not count as success.
CASE WHEN any_value(has_goal) AND coalesce(any_value(goal_source), 'logged') = 'logged'
    THEN bool_or(terminated AND reward > goal_reward / 2)
        AND NOT bool_or(bumped AND step_index > 0)
END AS success,
sum(progress_m) AS progress_m,
count(*) FILTER (WHERE bumped) AS bumped_steps,
min(clearance_m) AS clearance_min_m,
list_sort(list_distinct(flatten(list(conditions)))) AS conditions,
list_sort(list(DISTINCT behaviour_policy)) AS behaviour_policies,
arg_min(behaviour_policy, step_index) AS first_policy,
count(*) FILTER (WHERE handover) AS handovers,
list_sort(list(DISTINCT zone)) AS zones
