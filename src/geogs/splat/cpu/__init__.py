"""The renderer on the CPU: numba kernels over tiles, run by a small thread pool."""
