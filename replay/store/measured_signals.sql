-- What drift is looked for in, from the rows. Where manifests keep it (summaries.sql), nothing is
-- scanned.

-- One value an episode of each signal.
CREATE OR REPLACE VIEW measured_signals AS
(
    -- include: measured_signals.sql
)
UNION ALL BY NAME
(
    -- include: measured_custom_signals.sql
);

-- Steps of each episode by zone.
CREATE OR REPLACE VIEW zone_steps AS
-- include: zone_steps.sql
;

-- Steps and events of each condition, by episode and zone.
CREATE OR REPLACE VIEW condition_steps AS
-- include: condition_steps.sql
;
