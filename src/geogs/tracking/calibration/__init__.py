"""Self-calibration: focal length and distortion, out of the video itself."""
