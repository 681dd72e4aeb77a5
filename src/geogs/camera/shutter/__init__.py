"""The rolling shutter: rotation of the camera while it reads an image row by row.

Each row has its own time. Each image is rectified to the time of its middle row by rotation alone,
with the angular velocity estimated from the video; the readout is given by the user or estimated
from the video.
"""
