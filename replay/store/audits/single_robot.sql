-- severity: warning
-- advice: Check the robot (its wheels, its lidar, its floor) before learning from it: the other robots may never meet this condition, or a fault may look like it. `FROM coverage_by_robot` has the rates.
-- doc: Conditions that (almost) only one robot has seen, although others drove too: a fault of the robot, or something that only its site has.
WITH seen AS (
    SELECT
        robot,
        condition,
        CAST(sum(rows) AS BIGINT) AS rows,
        CAST(sum(episodes) AS BIGINT) AS episodes
    FROM recording_conditions
    JOIN (SELECT recording_id, robot FROM recordings) USING (recording_id)
    WHERE robot IS NOT NULL
    GROUP BY robot, condition
), driven AS (
    SELECT robot, sum(rows) / sum(sum(rows)) OVER () AS share_of_rows FROM seen GROUP BY robot
)
SELECT condition, robot, rows, episodes, share, share_of_rows
FROM (SELECT *, rows / sum(rows) OVER (PARTITION BY condition) AS share FROM seen)
JOIN driven USING (robot)
WHERE episodes >= $min_episodes AND share >= $max_share AND share_of_rows < $max_share AND condition <> 'nominal'
ORDER BY condition
