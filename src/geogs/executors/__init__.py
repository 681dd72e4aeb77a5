"""When, and in which thread, the stages of SLAM run: in order, with the map at the end, or live."""
