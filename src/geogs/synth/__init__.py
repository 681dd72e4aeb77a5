"""Procedural scenes with exact truth: depth, normals, mesh, poses; for demo, tests, training.

``stage.make_stage`` gives a furnished room or a street and a motion through it; ``raycast.Raycaster``
renders it from any pose, ``shooting.Shooting`` as a camera with flaws sees it; ``export`` does it all
and writes a data set.
"""
