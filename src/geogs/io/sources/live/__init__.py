"""Sources that do not wait: cameras, streams, pipes, and files that play at their pace."""
