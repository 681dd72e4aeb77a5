"""What synthetic scenes are made of."""
