"""Photographs, and videos that tracking cannot follow: placed by structure from motion."""
