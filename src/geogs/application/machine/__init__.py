"""The machine: compute devices, compilation and self-tests."""
