"""Scheduling of the stages of SLAM: in order, with the map at the end, or live in threads."""
