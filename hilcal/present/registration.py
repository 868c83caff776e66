"""Reports on registration, frames, joint torques and the contents of covariances."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from hilcal import numbers
from hilcal.cell import Cell, Observer
from hilcal.identification.fit import Fit
from hilcal.identification.noise.full_covariance import CovarianceParts
from hilcal.identification.noise.noise_estimate import NoiseEstimate
from hilcal.identification.registration.misdescription import OtherArm
from hilcal.identification.registration.registration import Registration, Undetermined, register
from hilcal.identification.registration.robot_frames import RobotFrames
from hilcal.identification.torques import ARM, TOOL, TorqueCheck, TorqueFactor
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Mode
from hilcal.robot import se3
from hilcal.types import Floats

DECIMALS = 5, 4  # decimals of a position in m and of an angle in degrees. A choice
ALONG = 0.98  # least component of a unit vector that is named after its axis
WORDS: dict[CovarianceParts, str] = {
    "instrument": "the instrument alone; the arm's own scatter is not in it ([repeatability] "
    "joint_std_rad states it)",
    "instrument and repeatability": "the instrument, and the arm's scatter as [repeatability] "
    "states it",
    "instrument and arm as stated": "instrument and arm's scatter together; [repeatability] is not "
    "added again",
    "as imported": "as an older version of hilcal imported it; [repeatability] is not added "
    "(import the table again for that)",
}


def registration_lines(registration: Registration) -> Iterator[str]:
    """Yield the estimated poses of base and target, and the residual of the nominal arm."""
    if registration.estimated:
        rad = registration.turn_rms
        turn = "" if rad is None else f" and {np.degrees(rad):.3g}°"
        cell = registration.cell
        base = f"the base is at {_place(cell.registration)} in the tracker frame"
        if cell.observers and np.array_equal(cell.registration, np.eye(4)):
            base = "positions are in the axes of the base, which nothing else fixes"
        places = "".join(f"; {_observer(o)}" for o in cell.observers if o.free)
        yield (
            f"Registered: {base}; {_targets(cell)}{places}. "
            f"The nominal arm leaves {numbers.length(registration.rms)}{turn} rms."
        )
    yield from undetermined_lines(registration)


def observed_words(readings: Readings) -> str:
    """Return the number and kind of readings of each observer."""
    kinds = {"station": "positions by", "point": "distances from", "gauge": "heights of"}
    count = np.bincount(readings.observer, minlength=len(readings.observers)).tolist()
    pairs = zip(readings.observers, count, strict=True)
    return ", ".join(f"{n} {kinds[o.kind]} {o.name}" for o, n in pairs)


def _observer(o: Observer) -> str:
    inverse = se3.inverse(o.frame)
    if o.name.kind == "point":
        offset = f", offset {1e3 * o.offset:.3f} mm" if 3 in o.free else ""
        return f"{o.name} is at {_place(se3.matrix(np.eye(3), inverse[:3, 3]))}{offset}"
    if o.name.kind == "gauge":
        unit = ", ".join(f"{x:z.4f}" for x in o.frame[0, :3])
        return f"{o.name} has the direction ({unit}) and reads 0 {-o.frame[0, 3]:.5f} m along it"
    return f"{o.name} stands at {_place(inverse)}"


def other_arm_line(arm: OtherArm) -> str:
    """Return a sentence on another arm of the catalogue that fits the readings better."""
    return (
        f"These data fit the {arm.name} better: {numbers.length(arm.rms)} → "
        f"{numbers.length(arm.rms_with)} rms after registration; in CELL.toml: "
        f'[robot] model = "{arm.name}".'
    )


def fitted_lines(fit: Fit) -> Iterator[str]:
    """Yield the pose of the robot's base, the fitted targets and their undetermined directions."""
    roles = [e.role for e in fit.model.effects]
    yield base_line(fit.model.cell, fit.frames, fit.mode)
    if "target" in roles:
        yield f"As fitted, {_targets(fit.model.cell.with_targets(fit.frames.targets))}."
    if "target" in roles or "registration" in roles:
        yield from undetermined_lines(register(fit.model.cell, fit.readings))


def base_line(cell: Cell, frames: RobotFrames, mode: Mode = "absolute") -> str:
    """Return the pose of the robot's base; deflections determine it to 1 mm only."""
    if np.array_equal(frames.base, np.eye(4)) and frames.base_stated:
        return "The robot's base: the axes that the positions are given in."
    why, places = "as the cell states it", DECIMALS
    if not frames.base_stated:
        why = "the nominal arm on it has the axis of joint 1 where the readings have it"
        if mode == "deflection":
            why, places = f"{why}; deflections do not determine it better", (3, 2)
    return f"The robot's base: at {_place(frames.base, places)} in the tracker frame; {why}."


def undetermined_lines(registration: Registration) -> Iterator[str]:
    """Yield a sentence for each undetermined direction of the frames."""
    names = registration.cell.target_names if registration.cell.targets is not None else ()
    still = [int(k) + 1 for k in np.flatnonzero(registration.never_turned)]
    why = "the tool hardly changed its orientation, or turned about one axis only"
    if len(still) == 1:
        why = f"joint {still[0]} never turned"
    elif still and still == list(range(still[0], still[-1] + 1)):
        why = f"joints {still[0]} to {still[-1]} never turned"
    elif still:
        why = f"joints {numbers.names(list(map(str, still)))} never turned"
    for u in registration.undetermined:
        direction = _undetermined(u, names)
        verb = "separate" if " from " in direction else "determine"
        yield f"The poses cannot {verb} {direction}: {why}; it stays near its initial value."


def _undetermined(u: Undetermined, names: tuple[str, ...]) -> str:
    name = "" if u.target is None or not names else f" {names[u.target]}"
    if u.observers:
        place = f"the place of {' and '.join(u.observers)}"
        if not np.any(u.base_shift) and not np.any(u.base_turn) and u.target is None:
            return place
        return f"{place} from {_undetermined(replace(u, observers=()), names)}"
    moved = _moves(u.target_shift, u.target_turn, f"the target{name}'s", "the flange's")
    base = _moves(u.base_shift, u.base_turn, "the base's", "its")
    return " from ".join(filter(None, (moved, base))) or "a combination of base and target"


def _moves(shift: Floats, turn: Floats, whose: str, axes: str) -> str:
    parts = []
    if np.any(shift):
        along = _axis_words(shift, axes)
        height = whose == "the base's" and along == f"{axes} z"
        parts.append("the height of the base" if height else f"{whose} offset along {along}")
    if np.any(turn):
        parts.append(f"{whose} turn about {_axis_words(turn, axes)}")
    return " with ".join(parts)


def _axis_words(v: Floats, axes: str) -> str:
    k, unit = int(np.argmax(np.abs(v))), v / np.linalg.norm(v)
    if abs(unit[k]) > ALONG:
        return f"{axes} {'xyz'[k]}"
    return f"{axes} direction ({', '.join(f'{x:z.2f}' for x in unit)})"


def _targets(cell: Cell) -> str:
    if cell.targets is None:
        return f"the target is at {_place(cell.target)} on the flange"
    named = zip(cell.target_names, cell.targets, strict=True)
    return "; ".join(f"target {name} is at {_place(t)} on the flange" for name, t in named)


def _place(t: Floats, places: tuple[int, int] = DECIMALS) -> str:
    place = ", ".join(f"{x:z.{places[0]}f}" for x in t[:3, 3])
    turn = np.degrees(se3.rotation_vector(t[:3, :3]))
    if not np.any(np.abs(turn) > 1e-9):
        return f"({place}) m"
    rotation = ", ".join(f"{x:z.{places[1]}f}" for x in turn)
    return f"({place}) m, turned by the rotation vector ({rotation})°"


def covariance_words(parts: CovarianceParts, noise: NoiseEstimate | None = None) -> str:
    """Return the contents of the covariances as a clause; `noise`: its estimate if not stated."""
    if noise is None:
        return f"each covariance is that of {WORDS[parts]}"
    turn = arm = ""
    if noise.orientation_rad is not None:
        turn = f", orientations {1e6 * noise.orientation_rad:.2g} µrad"
    if noise.joint_std_rad is not None:
        scatter = f"{1e6 * noise.joint_std_rad:.2g} µrad"
        arm = f"; each joint scatters by {scatter} from arrival to arrival"
    why = "[tracker] does not state the noise, and the samples of each pose do not show all of it"
    if noise.factors is None:
        why = "neither the table nor [tracker] states the noise"
    return (
        f"{why}; it was estimated from the readings, together with all effects: "
        f"{numbers.length(noise.along_m)} along the beam, "
        f"{numbers.length(noise.across_m)} across it at {noise.distance_m:.2g} m{turn}{arm}"
    )


def torque_lines(check: TorqueCheck | None) -> Iterator[str]:
    """Yield a sentence for each mass that the torques contradict, and one for all others."""
    if check is None:
        return
    if not check.factors:
        yield "Measured joint torques: they determine neither a load nor a mass at these poses."
    for f in check.factors:
        if f.differs:
            yield f"Measured joint torques: {_differs(f)}."
    if right := [_size(f) for f in check.factors if not f.differs]:
        yield f"Measured joint torques agree with the description: {'; '.join(right)}."
    scatter = ", ".join(numbers.digits(x, 2) for x in check.std_Nm)
    yield f"Measured joint torques scatter about that by {scatter} N·m, joint by joint (friction)."


def _differs(f: TorqueFactor) -> str:
    mass = f.of if f.of in (ARM, TOOL) else f"load {f.of}"
    if f.factor < 0:
        return (
            f"{mass} acts with the other sign ({numbers.digits(f.factor)} times the described "
            "torques); tau1_Nm, ... are the torques that the drives exert, against the load's"
        )
    if f.stated_kg is None:
        return f"{mass} acts {numbers.digits(f.factor)} times as strongly as described{_band(f)}"
    return f"{mass} is {numbers.digits(f.factor * f.stated_kg)} kg, not {f.stated_kg:.4g}{_band(f)}"


def _size(f: TorqueFactor) -> str:
    if f.stated_kg is None:
        return f"{f.of} {numbers.digits(f.factor)} times as described{_band(f)}"
    return f"{f.of} {numbers.digits(f.factor * f.stated_kg)} kg{_band(f)}"


def _band(f: TorqueFactor) -> str:
    low, high = (numbers.digits((f.stated_kg or 1.0) * x) for x in (f.low, f.high))
    return f" (95 %: {low} to {high}{'' if f.stated_kg is None else ' kg'})"
