"""The procedural textured room: exact depth, normals, mesh and poses for demo, tests, training."""
