"""Training of the networks that are shipped: random rooms on the GPU, losses and loop."""

from geogs.cli.command import Command

COMMAND = Command("geogs_train.cli", "train the flow network that is shipped")
