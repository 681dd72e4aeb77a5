"""Many sources on many machines, by Ray: each is a run of its own, which may move between them."""

from geogs.cli.command import Command

COMMAND = Command("geogs_fleet.cli", "reconstruct many videos, on one machine or many")
