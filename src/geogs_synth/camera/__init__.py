"""Cameras and one model of their flaws, implemented twice.

Light comes in row by row (rolling shutter) and over the exposure (blur), through a lens that bends
(radial distortion) and darkens (vignetting); gains for exposure and white balance, a tone curve,
noise and JPEG make the image. A sequence has the flaws of one camera for all its frames
(``flaws``, ``sensors``: NumPy, a frame at a time, compressed by OpenCV); training draws others for
each picture (``clip_camera``: PyTorch, batches on a GPU, compression imitated).
"""
