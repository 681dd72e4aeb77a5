"""Names of the behaviours of lamps during a sequence."""

from typing import Literal

LampKind = Literal["steady", "switched"]
"""Constant lamps, or other lamps in each third of the sequence."""
