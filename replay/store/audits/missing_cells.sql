-- severity: warning
-- advice: The critic must guess the value of this action here: explore it in the twin, or take it out of the target's maximum.
-- doc: Condition x action cells with fewer rows than the minimum, empty ones included.
FROM cells_below($min_rows)
