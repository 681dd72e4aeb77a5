"""Errors shown to users. The message is one sentence: what is wrong and what to do."""


class GeogsError(Exception):
    """Base of every error that the command line prints without a traceback."""


class InputError(GeogsError):
    """The source, its calibration or an option cannot be used as given."""


class TrackingLost(GeogsError):
    """The camera motion could not be estimated (no parallax, no texture, blur)."""


class OutputError(GeogsError):
    """A result could not be written; what was already on disk is kept."""


class DeviceError(GeogsError):
    """A GPU, its driver or its compiler is missing or unsuitable."""
