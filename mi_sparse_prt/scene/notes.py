"""What is handled on the user's behalf while a scene is read: each fact is said once, of however many shapes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from mi_sparse_prt.core.errors import PrtWarning


class Fact(NamedTuple):
    """What there is to say of a shape, or of another thing, after its name.

    Attributes
    ----------
    one : str
        A ``{}`` in it is a number.
    many : str
        The same of several shapes, whose numbers are added up; empty if it reads alike.
    category : type of PrtWarning
    thing : str
    """

    one: str
    many: str = ""
    category: type[PrtWarning] = PrtWarning
    thing: str = "shape"


class Notes:
    """Facts, and the shapes that each of them is about."""

    def __init__(self) -> None:
        self._about: dict[Fact, tuple[list[str], list[int]]] = {}

    def add(self, shape: str, fact: Fact, number: int = 0) -> None:
        """Note a fact about a shape, or another thing."""
        names, numbers = self._about.setdefault(fact, ([], []))
        names.append(shape)
        numbers.append(number)

    def warnings(self) -> list[PrtWarning]:
        """One for each fact, in the order in which they came up."""
        found = []
        for fact, (names, numbers) in self._about.items():
            said = ((len(names) > 1 and fact.many) or fact.one).format(sum(numbers))
            found.append(fact.category(about(fact.thing, names) + said))
        return found


def about(thing: str, names: Sequence[str]) -> str:
    """What a sentence is about: one thing or several, by name."""
    return f"{thing}{'s' if len(names) > 1 else ''} {listed(names)}"


def listed(names: Sequence[str]) -> str:
    """The first names of shapes, and how many there are more."""
    most = 3
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(f"'{name}'" for name in names[:most]) + more
