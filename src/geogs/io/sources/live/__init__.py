"""Live sources: cameras, streams, pipes, and files played in real time."""
