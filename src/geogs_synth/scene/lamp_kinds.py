"""Names of what lamps do while a sequence is taken."""

from typing import Literal

LampKind = Literal["steady", "switched"]
"""As they are all the time, or others in each third of the sequence."""
