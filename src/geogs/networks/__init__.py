"""The networks' weights files: which there are, where they are, how they are read."""
