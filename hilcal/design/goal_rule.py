"""The stopping rule of a campaign: its goal, judged by a fit to the readings so far."""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.design.feasible import Space
from hilcal.design.goal import Goal, figures, parse_goal
from hilcal.design.nominal_model import after, nominal_model, planned_effects
from hilcal.design.predicted import positions_of, rms
from hilcal.design.prediction_poses import prediction_poses
from hilcal.effects.catalogue import Catalogue, installed
from hilcal.errors import HilcalError, InputError
from hilcal.identification.baseline import with_effects
from hilcal.identification.fit import Fit, fit
from hilcal.identification.full_covariance import with_joint_scatter
from hilcal.identification.priors import scales_of
from hilcal.measuring.progress import GoalStatus
from hilcal.readings.reading_groups import has_unloaded
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Mode
from hilcal.types import Floats

SHARE = 0.1
"""Share of the time that may be spent on fits while measuring."""


class GoalRule:
    """Judges a campaign by its goal, with the fit that `hilcal identify` would make at its end.

    The model is the effects of `[planning] model`. `[planning] readings` says what is fitted:
    positions, or deflections: then a loaded reading counts from its unloaded one on, and readings
    that are all unloaded are fitted as positions.

    The goal counts as met by a fit that converged, to readings that determine what the goal is
    about: unloaded readings, for one, determine no deflection. Where the residual is more than
    noise, the stated uncertainty is itself an estimate, and a check after every reading will once
    find it small by chance: then two fits in a row have to meet the goal, except at the plan's end.

    Fits take at most a tenth of the time (`SHARE`), so that none delays the campaign.

    Attributes:
        status: that of the last fit.
    """

    def __init__(
        self,
        text: str,
        cell: Cell,
        config: CellConfig,
        catalogue: Catalogue | None = None,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        """Read a goal, and check it against the cell's model.

        Args:
            text: the goal, e.g. "joint std < 2 %".
            config: `[planning]`, loads, repeatability.
            catalogue: the effects that a model can have; the installed ones unless given.
            now: seconds that pass for people.

        Raises:
            InputError: not a goal (lists the valid forms), or not one for this cell.
        """
        self.goal: Goal = parse_goal(text)
        self.status = GoalStatus(text)
        self._cell, self._config, self._now = cell, config, now
        self._catalogue = catalogue or installed()
        self._scatter = config.repeatability.per_joint(cell.arm.n)
        model = nominal_model(cell, config, 3, catalogue)
        effects = model.model.effects
        self.goal.check({f"{e.name}.{p.name}": p.unit for e in effects for p in e.parameters})
        self._work_q: tuple[tuple[float, ...], ...] = ()
        self._predicted = ""
        if self.goal.of_position:
            shown = "position" if config.fitted == "absolute" else "deflection"
            if self.goal.what != shown:
                raise InputError(
                    f'goal "{text}": [planning] readings = "{config.fitted}", which show the '
                    f"{shown}; valid: {shown}"
                )
            planning = config.planning
            if not planning.work_q_rad and planning.work_min_m is None:
                self.goal.met({}, {})  # raises: names the missing keys
            some = prediction_poses(
                model, config, np.zeros((0, cell.arm.n)), Space(cell, config).clear
            )
            self._work_q = tuple(dict.fromkeys(tuple(q) for q in some.q.tolist()))
            self._predicted = some.what
        self._good = False  # whether the fit before met the goal
        self._ended = self._took = -np.inf

    def __call__(self, readings: Readings, last: bool) -> GoalStatus:
        """Return the status of the goal, see `measuring.session.StoppingRule`."""
        begun = self._now()
        if last or (begun - self._ended >= self._took / SHARE and self._news(readings)):
            found = self._fit(readings)
            if found is None:
                self.status, self._good = GoalStatus(self.goal.text), False
            else:
                status, fitted = found
                good = status.met and fitted.solution.converged
                sure = last or self._good or not fitted.uncertainty.inflated
                self.status, self._good = replace(status, met=good and sure), good
            self._ended = self._now()
            self._took = self._ended - begun
        return self.status

    def _fitted(self, readings: Readings) -> tuple[Readings, Mode]:
        """Return the readings that are judged, and how.

        Where deflections are planned, a loaded reading counts as soon as its unloaded one is read.
        """
        if self._config.planning.readings == "absolute":
            return readings, "absolute"
        kept = readings[has_unloaded(readings)]
        return kept, "absolute" if kept.unloaded.all() else "deflection"

    def _news(self, readings: Readings) -> bool:
        """Whether the last reading is more than an unloaded one that no deflection has yet."""
        free = readings.unloaded
        if not free[-1] or self._fitted(readings)[1] == "absolute":
            return True
        same = (readings.pose == readings.pose[-1]) & (readings.cycle == readings.cycle[-1])
        return bool((same & ~free).any())

    def _fit(self, readings: Readings) -> tuple[GoalStatus, Fit] | None:
        """Fit and judge; None where that cannot be done yet."""
        try:
            readings, mode = self._fitted(readings)
            readings = with_joint_scatter(self._cell, readings, self._scatter)
            wanted = planned_effects(self._config, self._catalogue)
            model = with_effects(self._cell, readings, mode, wanted, wanted, self._catalogue)
            found = fit(model, readings, mode)
            std, value = figures(found)
            held = dict(zip(std, found.solution.prior == 0, strict=True))
            std = {name: s for name, s in std.items() if not held[name]}
            position = self._position(found) if self._work_q else None
            status = self.goal.met(std, value, position, self._predicted)
            return replace(status, model=found.model.named, fitted=found.mode), found
        except (HilcalError, np.linalg.LinAlgError):
            return None

    def _position(self, found: Fit) -> float:
        """RMS standard uncertainty of what is predicted where the robot will work, m.

        That of the fit's covariance T H⁻¹ Tᵀ, widened as `identify` widens the parameters'.
        Infinite where directions that the readings do not determine move the prediction. A family
        that the fit holds at zero may be so for want of readings, so that there have to be more
        degrees of freedom than it has parameters, and more than one in any case; where deflections
        are planned, some have to be read.
        """
        if found.mode != self._config.planning.readings:
            return float(np.inf)
        if found.dof <= max(int((found.solution.prior == 0).sum()), 1):
            return float(np.inf)
        where = {"work_q_rad": self._work_q, "work_min_m": None, "work_max_m": None}
        planning = self._config.planning.model_copy(update=where)
        config = self._config.model_copy(update={"planning": planning})
        model = after(found, config)
        work = prediction_poses(model, config, np.zeros((0, self._cell.arm.n)))
        solution, u = found.solution, found.uncertainty
        basis, scale = solution.equations.basis, scales_of(found.model)
        least = np.sqrt(max(found.variance_factor, 1.0)) if u.inflated else 1.0
        seen = u.identifiable & (u.formal > 0)
        wider = np.full(len(scale), least)
        wider[seen] = u.std[seen] / u.formal[seen]
        root: Floats = basis.transform * (wider / scale)[:, None]
        covariance = root @ solution.equations.inverse(solution.beta) @ root.T
        live = model.live
        return rms(positions_of(work, covariance[np.ix_(live, live)], basis.null[live]))
