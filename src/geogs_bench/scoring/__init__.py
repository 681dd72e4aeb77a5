"""From a result's folder and the truth of its scene to scores."""
