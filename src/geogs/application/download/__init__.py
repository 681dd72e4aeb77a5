"""Public sequences: a catalogue, download with resumption, safe unpacking."""
