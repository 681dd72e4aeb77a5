"""Rigid and similarity motions, the pinhole camera, depth maps and point sets.

Conventions (docs/conventions.md): OpenCV camera axes; ``T_dst_src`` maps points of src into dst;
tangents are ``[tau, phi(, sigma)]`` and act from the left, ``T <- Exp(xi) T``; quaternions are
``w, x, y, z``; pixel centres lie at integer coordinates; depth is z along the optical axis.
"""
