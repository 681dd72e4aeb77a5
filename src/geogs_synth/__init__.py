"""Procedural scenes with exact truth: depth, normals, mesh, poses; for demo, tests, training.

``stage.make_stage`` gives a furnished room or a street and a motion through it;
``raycast.Raycaster`` renders it from any pose, ``shooting.Shooting`` as a flawed camera sees it;
``export.write_sequence`` does it all and writes a data set.
"""

from geogs.cli.command import Command

COMMAND = Command("geogs_synth.cli", "make a synthetic room sequence with exact ground truth")
