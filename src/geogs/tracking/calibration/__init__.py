"""Self-calibration: focal length, and if asked one radial term, out of the video itself."""
