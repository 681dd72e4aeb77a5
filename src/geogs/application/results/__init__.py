"""Results of a run or a reconstruction, written to a folder and read from it."""
