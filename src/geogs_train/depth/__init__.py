"""Training of the multi-view depth network."""
