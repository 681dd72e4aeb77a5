"""The rolling shutter: how fast the camera turns while it reads an image row by row.

A row is seen at its own time. Each image is brought to the time of its middle row by rotation
alone, with the angular velocity that the video itself shows; the readout is given by the user or
found in the video.
"""
