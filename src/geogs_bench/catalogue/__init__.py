"""Every benchmark by its name, and what papers printed for it."""
