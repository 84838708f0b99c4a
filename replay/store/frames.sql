-- Camera frames, over stored_frames (the frame files that manifests name).

CREATE OR REPLACE VIEW frames AS
SELECT
    recording_id || '/' || camera || '/' || frame_index AS frame_id,
    * EXCLUDE (data),
    make_timestamp(stamp_ns // 1000) AS stamp_time
FROM stored_frames;

-- The last frame of each camera received at a transition's step, if it is not too old.
CREATE OR REPLACE VIEW transition_frames AS
SELECT
    steps.transition_id,
    steps.recording_id,
    seen.camera,
    seen.frame_id,
    seen.frame_index,
    seen.size_bytes,
    seen.stamp_ns AS frame_stamp_ns,
    (steps.stamp_ns - seen.stamp_ns) * 1e-9 AS age_s
FROM (
    SELECT transition_id, transitions.recording_id, stamp_ns, camera
    FROM transitions
    JOIN (SELECT DISTINCT recording_id, camera FROM frames) USING (recording_id)
) AS steps
ASOF JOIN frames AS seen
    ON steps.recording_id = seen.recording_id
    AND steps.camera = seen.camera
    AND steps.transition_id >= seen.first_transition_id
WHERE steps.transition_id <= seen.last_transition_id;
