-- Something stands in the way toward the next waypoint, and stays where it is: nearer than 1.1 m
-- for two steps, and at the same place of the map (within .4 m) as one and two seconds before. So
-- a person who walks in front, or crosses, blocks no aisle until they have stood there for long.
-- timing: pre
-- priority: 40
coalesce(
    max(clearance_ahead_m) OVER (episode ROWS BETWEEN 1 PRECEDING AND CURRENT ROW) < 1.1
    AND pow((pose_x_m + (clearance_ahead_m + 0.35) * cos(pose_yaw_rad + atan2(waypoint_near_y_m, waypoint_near_x_m)))
            - lag((pose_x_m + (clearance_ahead_m + 0.35) * cos(pose_yaw_rad + atan2(waypoint_near_y_m, waypoint_near_x_m))), 5) OVER episode, 2)
        + pow((pose_y_m + (clearance_ahead_m + 0.35) * sin(pose_yaw_rad + atan2(waypoint_near_y_m, waypoint_near_x_m)))
            - lag((pose_y_m + (clearance_ahead_m + 0.35) * sin(pose_yaw_rad + atan2(waypoint_near_y_m, waypoint_near_x_m))), 5) OVER episode, 2)
        < 0.16
    AND pow((pose_x_m + (clearance_ahead_m + 0.35) * cos(pose_yaw_rad + atan2(waypoint_near_y_m, waypoint_near_x_m)))
            - lag((pose_x_m + (clearance_ahead_m + 0.35) * cos(pose_yaw_rad + atan2(waypoint_near_y_m, waypoint_near_x_m))), 10) OVER episode, 2)
        + pow((pose_y_m + (clearance_ahead_m + 0.35) * sin(pose_yaw_rad + atan2(waypoint_near_y_m, waypoint_near_x_m)))
            - lag((pose_y_m + (clearance_ahead_m + 0.35) * sin(pose_yaw_rad + atan2(waypoint_near_y_m, waypoint_near_x_m))), 10) OVER episode, 2)
        < 0.16,
    false)
