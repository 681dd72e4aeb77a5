"""A keyframe's dense depth from matching with its neighbours."""
