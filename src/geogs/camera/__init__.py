"""The camera: how its lens bends, when its rows are seen, and images as a pinhole sees them."""
