"""Ray casters."""
