-- Values in which drift is searched, by a scan of all rows. summaries.sql reads them from manifests instead.

-- One value per episode and signal.
CREATE OR REPLACE VIEW measured_signals AS
(
    -- include: measured_signals.sql
)
UNION ALL BY NAME
(
    -- include: measured_custom_signals.sql
);

-- Steps per episode and zone.
CREATE OR REPLACE VIEW zone_steps AS
-- include: zone_steps.sql
;

-- Steps and events per episode, zone and condition.
CREATE OR REPLACE VIEW condition_steps AS
-- include: condition_steps.sql
;
