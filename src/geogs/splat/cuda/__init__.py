"""The renderer on a GPU: CUDA sources and the code that launches them."""
