"""The camera: lens distortion, rolling shutter, and straightening of images to a pinhole."""
