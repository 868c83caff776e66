"""`run --until`: a goal, judged while measuring by a fit to what is there."""

import re
import time
from collections.abc import Callable

import numpy as np

from hilcal.acquire.stopping_rule import Standing
from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.data.readings import Readings
from hilcal.data.whitening import Mode, usual_mode
from hilcal.effects.catalogue import Catalogue, installed
from hilcal.errors import HilcalError
from hilcal.identify.baseline import with_effects
from hilcal.identify.fit import Fit, fit
from hilcal.identify.fit_document import finite
from hilcal.identify.full_covariance import with_joint_scatter
from hilcal.identify.gauss_newton import scales_of
from hilcal.plan.feasible import Space
from hilcal.plan.goal import Goal, Verdict, figures, parse_goal
from hilcal.plan.nominal_model import after, assumed
from hilcal.plan.predicted import positions_of, rms
from hilcal.plan.prediction_poses import work_poses
from hilcal.report import numbers
from hilcal.types import Floats

SHARE = 0.1
"""Share of the time that may be spent on fits while measuring."""


class Until:
    """Judges a campaign by its goal, with a fit as `hilcal identify` would make it.

    It is the baseline, or the effects of `[planning] model`, fitted to deflections where every
    loaded reading has its unloaded one, else to the readings as they are; `[planning] readings
    = "absolute"` fits them so in any case. Standard uncertainties are those that are stated
    there.

    The goal counts as met by a fit that converged. Where the residual is more than noise, the
    uncertainty is itself an estimate: who looks after every reading will once see it small by
    chance. So then two fits in a row have to agree, but for the last one of a plan.

    Fits take at most a tenth of the time, so that none holds up the campaign.
    """

    def __init__(
        self,
        text: str,
        cell: Cell,
        config: CellConfig,
        catalogue: Catalogue | None = None,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        """Read a goal, and refuse it where nothing of the cell's model is meant.

        Args:
            text: the goal, e.g. "joint std < 2 %".
            cell: the cell.
            config: `[planning]`, loads, repeatability.
            catalogue: the effects that a model can have; the installed ones unless given.
            now: seconds that pass for people.

        Raises:
            InputError: not a goal (lists the valid forms), or not one for this cell.
        """
        self.goal: Goal = parse_goal(text)
        self.standing = self._state(None, met=False)
        self._cell, self._config, self._now = cell, config, now
        self._catalogue = catalogue or installed()
        self._scatter = config.repeatability.per_joint(cell.arm.n)
        model = assumed(cell, config, 3, catalogue)
        effects = model.model.effects
        self.goal.check({f"{e.name}.{p.name}": p.unit for e in effects for p in e.parameters})
        self._work_q: tuple[tuple[float, ...], ...] = ()
        if self.goal.of_position:
            planning = config.planning
            if not planning.work_q_rad and planning.work_min_m is None:
                self.goal.met({}, {})  # says where it is told
            some = work_poses(model, config, np.zeros((0, cell.arm.n)), Space(cell, config).clear)
            self._work_q = tuple(dict.fromkeys(tuple(q) for q in some.q.tolist()))
        self._good = False  # whether the fit before said so
        self._ended = self._took = -np.inf

    def __call__(self, readings: Readings, last: bool) -> Standing:
        """Return how far the goal is, see `acquire.until.Rule`."""
        begun = self._now()
        if last or (begun - self._ended >= self._took / SHARE and self._news(readings)):
            judged = self._judge(readings)
            good = sure = False
            if judged is not None:
                verdict, found = judged
                good = verdict.met and found.solution.converged
                sure = last or self._good or not found.uncertainty.inflated
            self.standing = self._state(judged, met=good and sure)
            self._good = good
            self._ended = self._now()
            self._took = self._ended - begun
        return self.standing

    def _mode(self, readings: Readings) -> Mode:
        wanted = self._config.planning.readings
        return "absolute" if wanted == "absolute" else usual_mode(readings)

    def _news(self, readings: Readings) -> bool:
        """Whether the last reading is more than an unloaded one that no deflection has yet."""
        free = readings.unloaded
        if not free[-1] or self._mode(readings) == "absolute":
            return True
        same = (readings.pose == readings.pose[-1]) & (readings.cycle == readings.cycle[-1])
        return bool((same & ~free).any())

    def _judge(self, readings: Readings) -> tuple[Verdict, Fit] | None:
        """Fit and judge; None where that cannot be done yet."""
        try:
            readings = with_joint_scatter(self._cell, readings, self._scatter)
            mode, names = self._mode(readings), self._config.planning.model
            if readings.unloaded.all():  # no load has been hung yet
                elastic = {kind.name for kind in self._catalogue.with_role("baseline")}
                names = tuple(name for name in names if name not in elastic)
            model = with_effects(self._cell, readings, mode, names, None, self._catalogue)
            found = fit(model, readings, mode)
            std, value = figures(found)
            held = dict(zip(std, found.solution.prior == 0, strict=True))
            std = {name: s for name, s in std.items() if not held[name]}
            position = self._position(found) if self._work_q else None
            return self.goal.met(std, value, position), found
        except (HilcalError, np.linalg.LinAlgError):
            return None

    def _position(self, found: Fit) -> float:
        """RMS standard uncertainty of the position where the robot will work, m.

        That of the fit's covariance T H⁻¹ Tᵀ, widened as `identify` widens the parameters'.
        """
        where = {"work_q_rad": self._work_q, "work_min_m": None, "work_max_m": None}
        planning = self._config.planning.model_copy(update=where)
        config = self._config.model_copy(update={"planning": planning})
        model = after(found, config)
        work = work_poses(model, config, np.zeros((0, self._cell.arm.n)))
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

    def _state(self, judged: tuple[Verdict, Fit] | None, *, met: bool) -> Standing:
        content: dict[str, object] = {"text": self.goal.text, "met": met}
        if judged is None:
            unknown = dict.fromkeys(("ratio", "worst", "std", "unit", "model", "fitted"))
            return Standing(met, "", {**content, **unknown})
        v, found = judged
        content |= {"ratio": finite(v.ratio), "worst": v.worst, "std": finite(v.std)}
        content |= {"unit": v.unit, "model": list(found.model.names), "fitted": found.mode}
        return Standing(met, self._words(v), content)

    def _words(self, v: Verdict) -> str:
        """The present value, e.g. "joint std 4.1 % (j6)"."""
        match = re.match(r"[\w.]+", self.goal.text.strip())
        what = self.goal.what if match is None else match[0]
        which = "" if v.worst in (what, self.goal.what) else f" ({v.worst.split('.')[-1]})"
        if not np.isfinite(v.std):
            return f"{what} std unknown{which}"
        if v.unit == "%":
            return f"{what} std {numbers.digits(v.std, 2)} %{which}"
        unit, factor = numbers.unit_for(v.unit, (v.std,))
        return f"{what} std {numbers.digits(factor * v.std, 2)} {unit}{which}"

    def missed(self, count: int) -> str:
        """Return in one line by how much the goal was missed after so many readings."""
        head = f'goal "{self.goal.text}" is not met after all {count} readings'
        ratio = self.standing.figures.get("ratio")
        if not self.standing.words:
            return f"{head}: the model cannot be fitted to them"
        if not isinstance(ratio, float):
            return f"{head}: {self.standing.words}"
        if ratio <= 1.0:
            return f"{head}: {self.standing.words}, but the fit did not converge"
        return f"{head}: {self.standing.words}, {ratio:.2g} times what is asked for"
