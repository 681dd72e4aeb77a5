"""A window in the browser on a result, or on a run that is going on: served by viser."""
