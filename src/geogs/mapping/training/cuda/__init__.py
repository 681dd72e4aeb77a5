"""Training the map on a GPU."""
