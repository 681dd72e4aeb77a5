"""The terminal of a command: signals, keys, streams, messages."""
