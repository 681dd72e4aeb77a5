"""The networks' weights files: their catalogue, search and reading."""
