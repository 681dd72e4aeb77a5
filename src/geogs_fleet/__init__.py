"""Many sources on many machines, by Ray: each is a run of its own, which may move between them."""
