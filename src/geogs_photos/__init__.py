"""Poses of photographs, estimated from the photographs alone.

Features and the choice of pairs are our own; matching, verification and incremental structure from
motion are pycolmap's, which is an extra (``geogs[photos]``).
"""
