"""The JSON of a diagnosis."""

from hilcal.diagnose.verdict import Diagnosis


def to_json(d: Diagnosis) -> dict[str, object]:
    """Keys of the contract, and what repeats say of the noise."""
    return {
        "model": list(d.fit.model.names),
        "verdict": d.verdict,
        "message": d.message,
        "variance_factor": d.fit.variance_factor,
        "variance_factor_interval": list(d.fit.variance_factor_interval),
        "predictable_share": d.predictable_share,
        "where": [
            {"variable": v.variable, "share": v.share, "p_value": v.p_value} for v in d.where
        ],
        "suspects": [
            {
                "effect": s.effect,
                "p_value": s.score.p_value,
                "share": s.share,
                "holdout_share": s.holdout_share,
                "delta_bic": s.score.delta_bic,
                "log_evidence": s.score.log_evidence,
                "significant": s.effect in d.significant,
                "same_as": list(s.same_as),
            }
            for s in d.suspects
        ],
        "pure_error": None
        if d.pure_error is None
        else {
            "variance_factor": d.pure_error.factor,
            "interval": list(d.pure_error.interval),
            "dof": d.pure_error.dof,
            "lack_of_fit_p": d.pure_error.lack_of_fit_p,
        },
    }
