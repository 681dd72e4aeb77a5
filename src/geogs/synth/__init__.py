"""The procedural textured room: exact depth, normals, mesh and poses for demo, tests, training.

``room.make_room(seed)`` gives a ``scene.Scene``; ``raycast.Raycaster(scene)`` renders it;
``trajectory.handheld_trajectory`` walks a camera through it; ``export.write_sequence`` does it all
and writes a data set.
"""
