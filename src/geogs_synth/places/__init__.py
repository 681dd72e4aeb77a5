"""Rooms and streets, with their furniture and moving objects."""
