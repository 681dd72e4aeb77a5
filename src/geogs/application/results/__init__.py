"""Results: what a run or a reconstruction came to, written to a folder and read from it."""
