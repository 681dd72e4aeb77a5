"""Results in the formats of other programs; docs/formats.md has their conventions in a table."""
