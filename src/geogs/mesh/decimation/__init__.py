"""Decimation of a mesh to fewer triangles."""
