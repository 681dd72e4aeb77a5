"""Self-calibration: focal length and distortion, estimated from the video itself."""
