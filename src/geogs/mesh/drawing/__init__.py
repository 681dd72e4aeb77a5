"""Line drawings of a mesh: plans and sections."""
