"""Random rooms with exact geometry, made and rendered on the device while the network trains."""
