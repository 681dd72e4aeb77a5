"""What is made of a searched depth by looking at it once more: edges, sky, bare planes."""
