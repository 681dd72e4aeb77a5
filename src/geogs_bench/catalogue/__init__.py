"""Every benchmark by its name, with the published figures."""
