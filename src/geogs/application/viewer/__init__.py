"""Viewer in the browser for a result, or for a running run; served by viser."""
