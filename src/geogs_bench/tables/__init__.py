"""Tables, curves and the page of a benchmark."""
