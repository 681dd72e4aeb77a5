"""A result's folder, and what is kept of it."""
