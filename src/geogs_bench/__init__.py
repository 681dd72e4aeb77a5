"""Benchmarks: scenes of known data sets, run, scored and compared with the published figures."""

from geogs.cli.command import Command

COMMAND = Command("geogs_bench.cli", "run a benchmark and write its tables")
