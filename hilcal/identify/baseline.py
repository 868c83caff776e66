"""The model that every campaign starts from: the frames, and the joints where loads act."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from hilcal.cell import Cell
from hilcal.data.readings import Readings
from hilcal.data.whitening import Mode
from hilcal.effects.catalogue import make
from hilcal.effects.options import Options, reading_options
from hilcal.effects.protocol import Effect
from hilcal.identify.registration import register
from hilcal.model import Model

ARM = 0.5
"""Lever by which a registration that is off by a length is off by an angle, m."""


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """A registered cell and the effects that belong to its frames.

    Attributes:
        cell: the cell with registration and target estimated where unknown.
        frames: `base_frame` and `target_offset` where they were unknown.
        error: rms 3-D distance of the readings from the closed-form start, m.
    """

    cell: Cell
    frames: tuple[Effect, ...]
    error: float


def start(cell: Cell, readings: Readings, mode: Mode) -> Start:
    """Register the cell; what was unknown becomes part of the fit.

    In deflection mode the frames act only by turning deflections, so their closed-form
    estimate from the positions enters as a prior as wide as that estimate was off.
    """
    registered = register(cell, readings)
    bare = Model(registered, ())
    o = bare.predict(readings.states, np.zeros(0)).observation
    off = readings.value[:, :3] - o.position
    error = float(np.sqrt(np.mean(np.sum(off**2, axis=1))))
    options: dict[str, object] = {}
    if mode == "deflection":
        length = max(error, 1e-6)
        options = {"prior_m": length, "prior_rad": length / ARM}
    frames = []
    if not cell.registration_known:
        frames.append(make("base_frame", registered, readings.states, options))
    if not cell.target_known:
        turned = reading_options("target_offset", readings.m)
        frames.append(make("target_offset", registered, readings.states, {**options, **turned}))
    return Start(registered, tuple(frames), error)


def baseline(cell: Cell, readings: Readings, mode: Mode) -> Model:
    """Frames, and `joint_compliance` where any reading was taken under a load."""
    begun = start(cell, readings, mode)
    model = Model(begun.cell, begun.frames)
    if np.any(readings.states.wrench != 0):
        model = model + make("joint_compliance", begun.cell, readings.states)
    return model


def with_effects(
    cell: Cell,
    readings: Readings,
    mode: Mode,
    names: Iterable[str],
    options: Mapping[str, Options] | None = None,
) -> Model:
    """Frames where unknown, and the named effects.

    Args:
        cell: the cell.
        readings: what is to be fitted.
        mode: "deflection" or "absolute".
        names: of the effects.
        options: by name, where they are not the usual ones.

    Raises:
        InputError: an unknown effect or option, a bad value, or readings that lack what an
            effect needs.
    """
    begun, given = start(cell, readings, mode), options or {}
    frames = (
        e.with_options(readings.states, **given[e.name]) if given.get(e.name) else e
        for e in begun.frames
    )
    model = Model(begun.cell, tuple(frames))
    for name in names:
        if name not in model.names:
            all_options = {**reading_options(name, readings.m), **given.get(name, {})}
            model = model + make(name, begun.cell, readings.states, all_options)
    return model
