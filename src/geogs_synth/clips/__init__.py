"""Batches of short clips of random rooms, for training."""
