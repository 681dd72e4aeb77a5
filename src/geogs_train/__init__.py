"""Training of the shipped networks: random rooms on the GPU, losses and loop."""

from geogs.cli.command import Command

COMMAND = Command("geogs_train.cli", "train the flow network that is shipped")
