"""A mesh with fewer triangles."""
