"""Checkpoints: the state of some work, stored in its folder to resume from."""
