"""Revisions of a searched depth: edges, sky, bare planes."""
