"""Sequences with their truth, written as a data set."""
