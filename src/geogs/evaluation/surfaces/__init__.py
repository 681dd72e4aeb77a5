"""Errors of a surface against the true one, by every protocol in use."""
