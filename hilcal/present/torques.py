"""What measured joint torques say of the described masses and loads."""

from collections.abc import Iterator

from hilcal import numbers
from hilcal.identification.torques import ARM, TOOL, TorqueCheck, TorqueFactor


def torque_lines(found: TorqueCheck | None) -> Iterator[str]:
    """Yield a sentence for each described mass that the torques contradict, else one for all."""
    if found is None:
        return
    left = ", ".join(numbers.digits(x, 2) for x in found.std_Nm)
    if not found.factors:
        yield "Measured joint torques: the poses tell neither a load nor a mass by them."
    for f in found.factors:
        if f.differs:
            yield f"Measured joint torques: {_differs(f)}."
    right = [_size(f) for f in found.factors if not f.differs]
    if right:
        yield f"Measured joint torques agree with the description: {'; '.join(right)}."
    yield f"Measured joint torques scatter about that by {left} N·m, joint by joint (friction)."


def _differs(f: TorqueFactor) -> str:
    what = f.of if f.of in (ARM, TOOL) else f"load {f.of}"
    if f.factor < 0:
        return (
            f"{what} acts with the other sign ({numbers.digits(f.factor)} times the described "
            "torques); tau1_Nm, ... are the torques that the drives exert, against the load's"
        )
    if f.stated_kg is None:
        return f"{what} acts {numbers.digits(f.factor)} times as strongly as described{_band(f)}"
    return f"{what} is {numbers.digits(f.factor * f.stated_kg)} kg, not {f.stated_kg:.4g}{_band(f)}"


def _size(f: TorqueFactor) -> str:
    if f.stated_kg is None:
        return f"{f.of} {numbers.digits(f.factor)} times as described{_band(f)}"
    return f"{f.of} {numbers.digits(f.factor * f.stated_kg)} kg{_band(f)}"


def _band(f: TorqueFactor) -> str:
    unit = 1.0 if f.stated_kg is None else f.stated_kg
    low, high = numbers.digits(unit * f.low), numbers.digits(unit * f.high)
    return f" (95 %: {low} to {high}{'' if f.stated_kg is None else ' kg'})"
