"""Account of an input: findings beside the images, used or not, with the reason."""

from collections.abc import Sequence
from dataclasses import dataclass

MOST_NAMED = 3
"""Largest number of files, keys or topics that one line names."""


@dataclass(frozen=True, slots=True)
class Account:
    """Sentences on an input, without a full stop, for the terminal and ``summary.json``.

    Every reader adds its own; two accounts are joined by ``+``. An input that the user named and
    that cannot be used is no line here but an ``InputError``.
    """

    used: tuple[str, ...] = ()
    """Findings that are used, with their origin, such as "fx 160.0 pixels from x_fov"."""
    left: tuple[str, ...] = ()
    """Findings that are not used, each with the reason."""

    def __add__(self, other: "Account") -> "Account":
        """Both accounts, each sentence once."""
        return Account(
            tuple(dict.fromkeys((*self.used, *other.used))),
            tuple(dict.fromkeys((*self.left, *other.left))),
        )

    def lines(self, found: str) -> list[str]:
        """The account as the terminal shows it, below a sentence on the images."""
        used = [f"  {sentence}." for sentence in self.used]
        return [f"Input: {found}.", *used, *(f"  not used: {sentence}." for sentence in self.left)]


def named(names: Sequence[str]) -> str:
    """A list of names for a message: the first few, and how many more there are."""
    more = len(names) - MOST_NAMED
    return ", ".join(names[:MOST_NAMED]) + (f" and {more} more" if more > 0 else "")
