"""How the shipped flow network is made: random rooms on the GPU, loss and loop."""
