-- Returns of drivers in a run's evaluations (`restock eval`, all drivers on the same missions), with the
-- columns that return_order.sql reads. `{schema}` is the run's schema. Returns have the run's discount.
CREATE OR REPLACE VIEW "{schema}".driven_episodes AS
SELECT
    concat_ws('/', layouts, layout, perturbation, to_json(perturbation_values), condition, episode_seed) AS mission,
    concat_ws(' ', policy, nullif(version, '')) AS driver,
    false AS handed_over,
    concat(
        condition,
        CASE WHEN block IN ('none', '') THEN '' ELSE concat(' (', block, ')') END,
        CASE WHEN perturbation = 'none' THEN '' ELSE concat(', ', perturbation) END
    ) AS condition,
    coalesce(failure, 'goal') AS outcome,
    success,
    return,
    discounted_return
FROM "{schema}".eval_episodes;

CREATE OR REPLACE VIEW "{schema}".returns AS FROM returns_of('{schema}.driven_episodes');
