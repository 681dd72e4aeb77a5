"""Bundle adjustment on a GPU."""
