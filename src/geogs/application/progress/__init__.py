"""Progress of a run: its stages, messages and remaining time."""
