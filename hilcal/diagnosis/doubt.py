"""Which effects further measurements should separate: what an ambiguous diagnosis leaves open."""

from hilcal.diagnosis.diagnosis import Diagnosis

MOST = 4
"""Effects to separate at once at most: each pair, both ways round, is a term of the design; a
guess."""


def in_doubt(d: Diagnosis, most: int = MOST) -> tuple[str, ...]:
    """Return effects that the readings do not separate; none unless the verdict is `ambiguous`.

    Either they are all missing from the model, the first suspect first, or the first one is an
    addition to the model that one of the others could replace, or they all depend on the pose
    alone, as the misfit does.

    Args:
        d: the diagnosis.
        most: number of effects at most.
    """
    if d.reason == "inseparable_suspects":
        return (d.suspects[0].effect, *(s.effect for s in d.separability))[:most]
    if d.reason == "inseparable_addition":
        a = next(a for a in d.alternatives if a.inseparable)
        return (a.effect, *(a.same_as or a.others))[:most]
    if d.pose_alone is not None:
        return d.pose_alone.effects[:most]
    return ()
