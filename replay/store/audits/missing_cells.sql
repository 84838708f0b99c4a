-- severity: warning
-- advice: The critic must guess the value of this action in this condition: explore it in the twin, or exclude it from the target's maximum.
-- doc: Condition x action cells with fewer rows than the minimum, including empty cells.
FROM cells_below($min_rows)
