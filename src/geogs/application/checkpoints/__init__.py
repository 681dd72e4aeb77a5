"""Checkpoints: the state of some work, kept in its folder to go on from."""
