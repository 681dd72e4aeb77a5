"""Bundle adjustment over poses, inverse depths and the lens."""
