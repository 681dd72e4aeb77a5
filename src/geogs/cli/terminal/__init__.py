"""The terminal that a command is given: signals, keys, streams, words."""
