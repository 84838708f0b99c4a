-- From a near collision (clearance below .14 m, or a bump) until there is room again (.3 m), at
-- most 2 s.
-- timing: pre
-- priority: 10
coalesce(
    stamp_ns - max(CASE WHEN clearance_m < 0.14 OR bumped THEN stamp_ns END) OVER episode <= 2000000000
    AND max(CASE WHEN clearance_m < 0.14 OR bumped THEN stamp_ns END) OVER episode
        > coalesce(max(CASE WHEN clearance_m > 0.3 AND NOT bumped THEN stamp_ns END) OVER episode, 0),
    false)
