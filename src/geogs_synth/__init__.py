"""Procedural scenes with exact truth: for demo, tests, evaluation and training.

``scene`` holds the parts of a scene, ``raycast`` renders it. ``places`` furnishes rooms and builds
streets through which ``motion`` leads a camera; ``sequence.replica_files`` films one with the flaws
of a ``camera`` and writes a data set. ``clips`` draws batches of simpler rooms and films them for
training.
"""

from geogs.cli.command import Command

COMMAND = Command("geogs_synth.cli", "make a synthetic room sequence with exact ground truth")
