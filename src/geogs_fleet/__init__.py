"""Many sources on many machines, by Ray: each is its own run, which may move between machines."""

from geogs.cli.command import Command

COMMAND = Command("geogs_fleet.cli", "reconstruct many videos, on one machine or many")
