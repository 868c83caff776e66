"""What a value says to people is written above it: the library names who writes it, when asked."""

from typing import Protocol


class Presenter(Protocol):
    """Writes what values say; `hilcal.presenter` returns it."""

    def html_of(self, value: object) -> str:
        """Return a value as a notebook shows it."""
        ...

    def message(self, of: object) -> str:
        """Return a diagnosis in a sentence."""
        ...


class Shown:
    """A value that notebooks show in words and tables."""

    __slots__ = ()

    def _repr_html_(self) -> str:
        return presenter().html_of(self)


def presenter() -> Presenter:
    """Return who writes what values say; the library is loaded wherever one of its values is."""
    import hilcal

    return hilcal.presenter()
