"""Motions of cameras."""
