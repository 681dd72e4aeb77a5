"""Guards against hostile and damaged files, names, folders, servers and calls."""
