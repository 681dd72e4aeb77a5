"""CUDA kernels from package sources: compiled at first use, cached, launched on the stream."""
