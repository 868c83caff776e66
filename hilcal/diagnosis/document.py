"""A diagnosis as JSON: in documents of commands and in campaign files."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING

import numpy as np

from hilcal.diagnosis.effect_ranking import FALSE_ALARM, Suspect
from hilcal.diagnosis.minimum_detectable_effect import Strength
from hilcal.diagnosis.noise import PureError
from hilcal.diagnosis.residual_regression import Dependence
from hilcal.shown import presenter
from hilcal.store.codec import encode

if TYPE_CHECKING:
    from hilcal.diagnosis.diagnosis import Diagnosis


def to_json(d: "Diagnosis") -> dict[str, object]:
    """Return a diagnosis as JSON: the keys of the contract and further ones."""
    return {
        "model": list(d.fit.model.named),
        "verdict": d.verdict,
        "message": presenter().message(d),
        "reason": d.reason,
        "variance_factor": d.fit.variance_factor,
        "variance_factor_interval": list(d.fit.variance_factor_interval),
        "predictable_share": d.predictable_share,
        "where": [asdict(v) for v in d.misfit_breakdown],
        "suspects": [suspect_json(s) for s in d.suspects],
        "not_shown": list(d.not_shown),
        "tests": {"count": d.tested, "level": FALSE_ALARM, "each": FALSE_ALARM / max(d.tested, 1)},
        "apart": [
            {"effect": a.effect, "unlike": a.unlike, "times": a.times if a.possible else None}
            for a in d.separability
        ],
        "beyond": d.insufficiency
        and _attributes(d.insufficiency, "effects", "refitted", "share", "variance_factor"),
        "background": [_attributes(b, "effect", "p_value", "rms_m") for b in d.background],
        "wrong_figures": [asdict(f) for f in d.wrong_figures],
        "pose_alone": d.pose_alone and asdict(d.pose_alone),
        "rejected": list(d.history.rejected),
        "alternatives": [
            _attributes(a, "effect", "same_as", "others") for a in d.alternatives if a.inseparable
        ],
        "needless": list(d.redundant),
        "carriers": carriers(d.dependences),
        "arm_scatter": d.scatter and d.scatter.to_json(),
        "serial_noise": d.fit.readings.serial and d.fit.readings.serial.to_json(),
        "pure_error": d.pure_error and repeats(d.pure_error),
    }


def suspect_json(s: Suspect) -> dict[str, object]:
    """Return one suspect as JSON."""
    return {
        "effect": s.effect,
        "finer_than": s.coarse or None,
        "p_value": s.score.p_value,
        "share": s.share,
        "holdout_share": s.holdout_share,
        "delta_bic": s.score.delta_bic,
        "log_evidence": s.score.log_evidence,
        "significant": s.passes,
        "same_as": list(s.same_as),
        "least": least(s.least),
        "shown": s.shown,
        "plausible": s.plausible,
        "needs": [{"unit": unit, "rms": rms, "plausible_rms": most} for unit, rms, most in s.needs],
        "kept_share": s.kept,
    }


def least(s: Strength) -> dict[str, object] | None:
    """Return the smallest strength that would have been revealed, SI; null where none would."""
    if not s.visible:
        return None
    finer = None
    if s.finest_m is not None:
        visible = bool(np.isfinite(s.finest_m))
        finer = {"visible": visible, "displacement_m": s.finest_m if visible else None}
    return {
        "displacement_m": s.displacement_m,
        "parameters": [{"unit": unit, "rms": rms} for unit, rms in s.parameters],
        "finer_than_poses": finer,
    }


def repeats(e: PureError) -> dict[str, object]:
    """Return the scatter of repeats; `where` is null if the scatter is the same everywhere."""
    w = e.where
    return {
        "variance_factor": e.factor,
        "interval": list(e.interval),
        "dof": e.dof,
        "lack_of_fit_p": e.lack_of_fit_p,
        "where": None
        if w is None
        else {
            "kind": w.kind,
            "name": w.name,
            "variance_factor": w.factor,
            "interval": list(w.interval),
            "p_value": w.p_value,
        },
    }


def carriers(dependences: Sequence[Dependence]) -> list[dict[str, object]]:
    """Return the variables that carry the predictable share, with their curves, SI units."""
    names = ("variable", "unit", "share", "moves", "direction", "labels", "x", "y", "error")
    return [_attributes(v, *names, "y_unit", "determined") for v in dependences]


def _attributes(value: object, *names: str) -> dict[str, object]:
    return {name: encode(getattr(value, name)) for name in names}
