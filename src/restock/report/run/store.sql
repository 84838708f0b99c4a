-- What the report shows of the store that the run's panel came from.

-- name: visited
-- Logged steps per cell of the floor, of recordings in its frame: the map's at ($x_m, $y_m), turned by
-- $yaw_rad.
WITH placed AS (
    SELECT (pose_x_m - $x_m) * cos($yaw_rad) + (pose_y_m - $y_m) * sin($yaw_rad) AS x_m,
           (pose_y_m - $y_m) * cos($yaw_rad) - (pose_x_m - $x_m) * sin($yaw_rad) AS y_m
    FROM transitions
    WHERE list_contains($recordings, recording_id)
)
SELECT floor(x_m / $cell_m) * $cell_m AS x_m,
       floor(y_m / $cell_m) * $cell_m AS y_m,
       count(*) AS rows
FROM placed
WHERE x_m IS NOT NULL AND y_m IS NOT NULL
GROUP BY ALL
ORDER BY ALL;

-- name: rare
-- Where a rare condition was logged, as in `visited`; every one, up to $most drawn the same way each time.
SELECT (pose_x_m - $x_m) * cos($yaw_rad) + (pose_y_m - $y_m) * sin($yaw_rad) AS x_m,
       (pose_y_m - $y_m) * cos($yaw_rad) - (pose_x_m - $x_m) * sin($yaw_rad) AS y_m,
       primary_condition AS condition
FROM transitions
WHERE primary_condition <> 'nominal' AND list_contains($recordings, recording_id) AND pose_x_m IS NOT NULL
ORDER BY hash(transition_id)
LIMIT $most;

-- name: logged
-- The conditions that logged episodes met: the nearest thing to deployment that there is. An
-- episode that met several counts for each; one that met none is nominal.
WITH met AS (
    SELECT episode_id, list_distinct(flatten(list(conditions))) AS met FROM transitions GROUP BY ALL
), each AS (
    SELECT episode_id, unnest(CASE WHEN len(met) = 0 THEN ['nominal'] ELSE met END) AS condition
    FROM met
)
SELECT condition, count(*) AS episodes, count(*) / sum(count(*)) OVER () AS share
FROM each
GROUP BY condition
ORDER BY episodes DESC, condition;
