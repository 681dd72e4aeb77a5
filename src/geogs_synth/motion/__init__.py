"""How cameras move."""
