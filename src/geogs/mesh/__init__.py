"""Surface extraction: depth maps to a coloured triangle mesh."""
