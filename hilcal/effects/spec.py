"""An effect by name and options, before it is built for a cell and readings."""

from dataclasses import dataclass, field

from hilcal.effects.options import Options
from hilcal.effects.protocol import Effect


@dataclass(frozen=True, slots=True)
class EffectSpec:
    """An effect that a model builds for its own cell and readings when it is added."""

    kind: str | type[Effect]  # its name in the catalogue of the model, or its class
    options: Options = field(default_factory=dict)  # those that differ from the usual ones

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.kind if isinstance(self.kind, str) else self.kind.name


def effect(kind: str | type[Effect], **options: object) -> EffectSpec:
    """Return an effect by name and options, to be added to a model.

    >>> hc.effect("creep", joints="each")
    EffectSpec(kind='creep', options={'joints': 'each'})

    Args:
        kind: a name of the model's catalogue, or a class.
        **options: those that differ from the usual ones, as `joints="each"`.
    """
    return EffectSpec(kind, options)
