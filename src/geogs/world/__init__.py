"""All persistent state: keyframes, edges, frames, loops and the map, in memory and on disk."""
