"""Keyframes: where they were taken, what they saw, and how much of it is in memory."""
