"""Laws that the readings speak for, as JSON; SI."""

from dataclasses import asdict

from hilcal.discovery.curve import Curve
from hilcal.discovery.discovery import Discovery, alternatives
from hilcal.discovery.law import Law
from hilcal.discovery.proposal import LawSearch
from hilcal.discovery.structures import pareto


def laws_json(s: LawSearch) -> dict[str, object]:
    """Return the searches of a refinement as JSON."""
    return {
        "discover": [
            {
                **discovery_json(d),
                "written": str(s.files[d.laws[0].name])
                if d.laws and d.laws[0].name in s.files
                else None,
            }
            for d in s.found
        ]
    }


def discovery_json(d: Discovery) -> dict[str, object]:
    """Return the document of `discover`."""
    return {
        "model": list(d.fit.model.named),
        "reason": d.reason,
        "attainable_share": d.attainable,
        "searched_share": d.searched_share,
        "candidates": d.candidates,
        "catalogue": list(d.catalogue),
        "carried_by": [
            {"variable": c.variable, "share": c.share, "moves": c.moves} for c in d.carried
        ],
        "laws": [law_json(law, d) for law in d.laws],
        "structures": [
            {
                "formula": x.form.text(),
                "probability": x.probability,
                "complexity": x.form.complexity,
                "holdout_share": x.holdout_share,
                "pareto": x in pareto(d.structures),
                "law": x.law or None,
            }
            for x in d.structures
        ],
        "refused": [{"formula": formula, "why": why} for formula, why in d.refused],
        "unfitted": [{"effect": effect, "why": why} for effect, why in d.unfitted],
        "average": dict(zip(("rms_m", "std_m"), d.average_m(), strict=True)) if d.laws else None,
        "curves": [curve_json(c) for c in d.curves],
    }


def law_json(law: Law, d: Discovery) -> dict[str, object]:
    """Return a law as JSON."""
    return {
        "name": law.name,
        "formula": law.formula,
        "latex": law.form.latex(),
        "acts_on": list(law.acts_on),
        "variables": list(law.variables),
        "parameters": [asdict(c) for c in law.parameters],
        "holdout_share": law.holdout_share,
        "p_value": law.p_value,
        "variance_factor": law.left,
        "probability": law.probability,
        "found_again": [{**asdict(a), "variables": list(a.variables)} for a in law.again],
        "alternatives": [x.form.text() for x in alternatives(d, law)],
        "resembles": [asdict(r) for r in law.resembles],
        "ranges": [
            {"quantity": symbol, "min": low, "max": high, "unit": unit}
            for symbol, low, high, unit in law.ranges
        ],
    }


def curve_json(c: Curve) -> dict[str, object]:
    """Return a curve as JSON: what is drawn, the binned readings, and the law; SI."""
    x, y, std, count = c.binned
    return {
        "site": c.site,
        "of": c.of,
        "unit": c.unit,
        "quantity": c.quantity,
        "quantity_unit": c.quantity_unit,
        "binned": [
            {"x": float(a), "y": float(b), "std": float(e), "readings": int(n)}
            for a, b, e, n in zip(x, y, std, count, strict=True)
        ],
        "law": [[float(a), float(b)] for a, b in c.line.T],
    }
