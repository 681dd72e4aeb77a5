"""Interactive model in a page: its content, its packing, and the HTML around it."""
