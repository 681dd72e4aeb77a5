"""Training the map, and poses on it: losses of some views, gradients, Adam."""
