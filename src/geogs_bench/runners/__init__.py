"""What runs a task of a benchmark: geogs, parts of it, and the baseline with colour."""
