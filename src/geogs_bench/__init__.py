"""Benchmarks: scenes of known data sets, run and scored in one go, beside the published figures."""
