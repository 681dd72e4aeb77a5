"""A result's folder, and its record."""
