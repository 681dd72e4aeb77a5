"""Rooms and streets, and what stands and moves in them."""
