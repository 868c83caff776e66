"""The JSON of where base and target are, and of what the poses could not tell of them."""

from collections.abc import Sequence

import numpy as np

from hilcal.identification.fit import Fit
from hilcal.identification.registration import Registration, Undetermined, register
from hilcal.robot import se3
from hilcal.types import Floats


def fit_to_json(fit: Fit) -> dict[str, object]:
    """Frames as fitted; residual and undetermined directions of the nominal arm's registration."""
    found = fit.frames
    registered = document(register(fit.model.cell, fit.readings), found.base, found.targets)
    return {**registered, "base_is": found.base_is}


def document(
    registered: Registration, base: Floats | None = None, targets: Floats | None = None
) -> dict[str, object]:
    """Return the JSON of a registration, or of the frames that a fit made of it."""
    cell = registered.cell
    own = cell.all_targets if targets is None else targets
    several = cell.target_names if cell.targets is not None else ()
    each = {name: _pose(t) for name, t in zip(several, own, strict=False)}
    return {
        "base": _pose(cell.registration if base is None else base),
        "target": _pose(own[0]),
        **({"targets": each} if each else {}),
        "estimated": registered.estimated,
        "rms_m": registered.rms,
        "rms_rad": registered.turn_rms,
        "undetermined": [_direction(u) for u in registered.undetermined],
        "joints_never_turned": (np.flatnonzero(registered.still) + 1).tolist(),
    }


def _pose(t: Floats) -> dict[str, Sequence[float]]:
    turn = se3.rotation_vector(t[:3, :3])
    return {"xyz_m": t[:3, 3].tolist(), "rotvec_rad": turn.tolist()}


def _direction(u: Undetermined) -> dict[str, object]:
    return {
        "target": u.target,
        "target_shift_m": u.target_shift.tolist(),
        "target_turn_rad": u.target_turn.tolist(),
        "base_shift_m": u.base_shift.tolist(),
        "base_turn_rad": u.base_turn.tolist(),
    }
