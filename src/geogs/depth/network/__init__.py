"""Our multi-view stereo network: keyframe depth where photometry alone fails."""
