"""A model that turns in a page: what it shows, how it is packed, and the HTML around it."""
