"""How far a run is, what it says of it, and how long it still takes."""
