"""Image sets whose camera poses are known: COLMAP, nerfstudio, DTU and the RGB-D data sets.

``sniff.open_posed_source(path, config)`` opens any of them;
``pose_check.check_poses(source)`` finds poses in another axis convention than the format's.
"""
