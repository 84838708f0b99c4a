-- From a near collision (clearance below `tight_clearance_m`, or a bump) until the clearance is twice
-- that limit again, for at most 2 s. Near collisions are detected as in near_collision, but only from
-- this step and earlier ones.
-- timing: pre
-- priority: 10
-- uncertain: 0.2 to 0.8
-- let room_m:
least(clearance_m, tight_clearance_m + 0.2)
-- let before_m:
coalesce(lag(room_m) OVER episode, room_m)
-- let around_m:
least((room_m + coalesce(lag(room_m, 2) OVER episode, tight_clearance_m + 0.2)) / 2, before_m + 2 * lidar_noise_m)
-- let before_odds:
2.7 * (tight_clearance_m - 0.75 * lidar_noise_m - 0.53 * before_m - 0.47 * around_m) / lidar_noise_m
-- let now_odds:
2 * (tight_clearance_m - 0.87 * lidar_noise_m - least(
    room_m + 0.5 * lidar_noise_m,
    0.6 * room_m + 0.4 * least(before_m, room_m + 2 * lidar_noise_m))) / lidar_noise_m
-- let near_odds:
CASE WHEN bumped THEN 9 ELSE greatest(before_odds, now_odds) END
-- let freed_ns:
coalesce(
    max(CASE WHEN clearance_m > 2 * tight_clearance_m + 0.01 AND NOT bumped THEN stamp_ns END)
        OVER episode,
    0)
-- let near_ns:
max(CASE WHEN near_odds > 0 THEN stamp_ns END) OVER episode
-- let latest_odds:
max(CASE WHEN near_odds > -6 THEN near_odds END) OVER (episode ROWS BETWEEN {1.8 s} PRECEDING AND CURRENT ROW)
-- let perhaps_ns:
max(CASE WHEN near_odds > -6 THEN stamp_ns END) OVER episode
-- label:
coalesce(near_ns > freed_ns AND stamp_ns - near_ns < 1900000000, false)
-- probability:
CASE WHEN perhaps_ns > freed_ns AND latest_odds IS NOT NULL THEN 1 / (1 + exp(-latest_odds)) ELSE 0 END
