"""How the shipped flow network is made: random rooms on the GPU, loss and loop."""

from geogs.cli.command import Command

COMMAND = Command("geogs_train.cli", "train the flow network that is shipped")
