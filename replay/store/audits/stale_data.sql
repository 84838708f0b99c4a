-- severity: warning
-- advice: The floor may have changed since then: record this condition again, or set max_age_days in the mixture.
-- doc: Conditions whose newest row is older than the limit.
SELECT condition, rows_held, newest, age_min_days
FROM ages
WHERE age_min_days > $max_age_days
ORDER BY age_min_days DESC
