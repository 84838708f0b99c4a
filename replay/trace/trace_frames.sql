-- The frame of each camera in force at a row's step. Its bytes stay where they are.
SELECT
    camera,
    topic,
    frame_index,
    log_time_ns,
    stamp_ns,
    ($stamp - stamp_ns) * 1e-9 AS age_s,
    encoding,
    width,
    height,
    size_bytes,
    sha256
FROM stored_frames
WHERE
    recording_id = $recording
    AND $id BETWEEN first_transition_id AND last_transition_id
QUALIFY row_number() OVER (PARTITION BY camera ORDER BY first_transition_id DESC) = 1
ORDER BY camera
