"""Pages of results and the pictures on them."""
