"""A volume of truncated signed distances, and the triangles of its zero level."""
