-- The latest frame of each camera at a row's step, without its image data.
SELECT
    camera,
    topic,
    frame_index,
    log_time_ns,
    stamp_ns,
    age_s,
    encoding,
    width,
    height,
    frames.size_bytes AS size_bytes,
    sha256
FROM frames
JOIN (FROM transition_frames WHERE transition_id = $id) USING (recording_id, camera, frame_index)
ORDER BY camera
