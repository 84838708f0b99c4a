-- Rows of the episodes of which some row is in `wanted`, in their order: where the robot was, and what
-- its signals say of where it was sent.
SELECT recording_id, episode_id, pose_x_m, pose_y_m, pose_yaw_rad, waypoint_far_x_m, waypoint_far_y_m,
       route_remaining_m, goal_distance_m
FROM transitions
WHERE episode_id IN (SELECT episode_id FROM transitions JOIN wanted USING (transition_id))
ORDER BY recording_id, episode_index, step_index
