"""What a fit taught of its arm; see `posterior` for the formulas."""

from dataclasses import replace

import numpy as np

from hilcal.effects.protocol import FRAME_ROLES, Effect
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.fit import Fit
from hilcal.identification.gauss_newton import whitened_jacobian
from hilcal.identification.posterior import Posterior, PosteriorEffect, Source, determined
from hilcal.identification.predictive import parameter_factor, predictive
from hilcal.identification.priors import scales_of
from hilcal.readings.ranges import ranges_of
from hilcal.readings.same_readings import prints
from hilcal.readings.whitening import whitening
from hilcal.regression.schur import schur_complement
from hilcal.store.revision import utc_now
from hilcal.store.rows import content_hash
from hilcal.types import Floats


def posterior_of(fit: Fit, source: Source | None = None) -> Posterior:
    """Return what a fit taught of its arm; arguments and errors are those of `Posterior.of`."""
    if fit.scaling != "gc":
        raise InputError(f"a prior needs a fit with scaling gc, this one has {fit.scaling}")
    model, cell = fit.model, fit.model.cell
    learnt = [e for e in model.effects if of_arm(e)]
    if not learnt:
        raise CannotAnswerError(
            f"the model {' + '.join(model.names) or 'of the nominal arm'} has no effect of the "
            "arm, only of the setup: there is nothing to carry over; run hilcal refine first"
        )
    mine = np.concatenate([np.full(len(e.parameters), of_arm(e)) for e in model.effects])
    interest, scale = np.flatnonzero(mine), scales_of(model)
    whole, own = _information(fit, scale)
    found = determined(schur_complement(whole, interest))
    scale = scale[interest]
    used, source = fit.readings[~fit.outlier], source or Source(created=utc_now())
    return Posterior(
        arm=cell.arm.name,
        links=cell.arm.links,
        mode=fit.mode,
        effects=tuple(PosteriorEffect(e.name, dict(e.options)) for e in learnt),
        names=tuple(f"{e.name}.{p.name}" for e in learnt for p in e.parameters),
        units=tuple(p.unit for e in learnt for p in e.parameters),
        scale=scale,
        mean=fit.theta[interest],
        information=found / (scale[:, None] * scale),
        own_precision=own[interest] / scale**2,
        scatter=fit.readings.arm_scatter,
        ranges=ranges_of(used.states, cell.arm.units),
        prints=prints(fit.readings),
        source=replace(
            source,
            readings_sha256=content_hash(fit.readings),
            n_readings=len(fit.readings),
        ),
    )


def of_arm(effect: Effect) -> bool:
    """Whether an effect is of the arm, so that another campaign of it has it, too."""
    return not (type(effect).of_setup or effect.role in FRAME_ROLES)


def _information(fit: Fit, scale: Floats) -> tuple[Floats, Floats]:
    """M (P, P) and the part of its diagonal by the effects' own priors, in ordinary magnitudes."""
    model, s = fit.model, fit.solution
    p = predictive(
        model, fit.theta, s.prior, fit.readings[~fit.outlier], fit.mode, fit.holdout.rms_sigma
    )
    w = fit.whitening
    if not p.excess.none:
        w = whitening(p.excess.of_readings(fit.readings[~fit.outlier], fit.mode), fit.mode, "gc")
    a = whitened_jacobian(model, s.prediction, s.theta, w, np.arange(model.size))
    a *= scale
    std = np.where(np.isinf(s.prior), np.inf, p.prior) / scale
    with np.errstate(divide="ignore"):
        own = np.where(std > 0, 1.0 / std**2, np.inf)
    # Of a family of which nothing is left at all: as ordinary as it starts.
    own[np.isinf(own)] = 1.0
    kappa = parameter_factor(p, fit.holdout.rms_sigma)
    return (a.T @ a / p.noise + np.diag(own)) / kappa, own / kappa
