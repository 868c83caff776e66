"""Test and evidence of a family of columns beside a fitted model; no refit is needed.

With r the whitened residual of the model, M the projection off its columns (`projection`) and
X (R, P) the family's columns in ordinary magnitudes, everything follows from

    S = Xᵀ M X,    g = Xᵀ r,    ‖r‖²

The whole family is judged at once:

- p-value: F-test of all P columns; for a family that is large against the degrees of freedom,
  the variance-component test gᵀ g / ‖r‖² (Rao score of a common variance), whose null
  distribution is a ratio of quadratic forms. Both are exact for normal errors, also when the
  noise is misjudged by a common factor.
- evidence: with the conjugate prior β | σ² ~ N(0, σ² t² 1), p(σ²) ∝ 1/σ² and ν degrees of freedom
  of r, the logarithm of the marginal-likelihood ratio of the model with the family to that
  without it is

      −½ log det(1 + t² S) − ½ ν log(‖r‖²_t / ‖r‖²),    ‖r‖²_t = ‖r‖² − gᵀ (S + t⁻²)⁻¹ g

  and β | r is Student's with ν degrees of freedom, mean (S + t⁻²)⁻¹ g and scale matrix
  (‖r‖²_t / ν) (S + t⁻²)⁻¹. This is exact for a model without priors; where it has some, ‖r‖²
  stands for rᵀ M⁻¹ r, which is larger by the penalty. t is where the evidence is largest. Of two
  families that explain the same, the smaller one has more evidence.

Diagnosis and planning use this one formula. With the stated noise taken for the true one (σ² = 1) a
misfit of variance factor φ would overstate the evidence of each direction by about φ.

Sources: O'Hagan and Forster, *Bayesian Inference* (2004), chapter 11; Goeman, van de Geer and van
Houwelingen, *Testing against a high dimensional alternative*, J. R. Stat. Soc. B 68 (2006) 477-493.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.stats import f as f_distribution

from hilcal.regression.quadratic_form import ratio_tail
from hilcal.regression.spectrum import Spectrum, spectrum
from hilcal.types import Floats

LARGE_FAMILY = 0.1
"""Share of the degrees of freedom from which a family counts as large; a guess."""
ROUNDING = 1e-12
STRENGTHS = np.logspace(-3, 3, 61)
"""Prior standard deviations τ that are tried, in ordinary magnitudes; t² = τ² ν / ‖r‖²."""


@dataclass(frozen=True, slots=True, eq=False)
class FamilyScore:
    """What a family explains.

    Attributes:
        p_value: of the joint test.
        log_evidence: gain in log evidence by adding the family.
        strength: τ where the evidence is largest.
        ridge: t⁻² there, the prior precision of the parameters in units of the noise; infinite
            where no direction is visible.
        rank: number of visible directions of the family.
        effective: effective number of parameters at that strength.
        gain: reduction of ‖r‖² at that strength.
        delta_bic: change of the Bayesian information criterion; negative speaks for it.
        step: (P,) posterior mean of the parameters, in ordinary magnitudes.
        spectrum: of S; None where no direction is visible.
        noise: ‖r‖²_t / ν.
        bounded: whether a larger strength than is plausible has more evidence.
        by_strength: (T,) log evidence at each of `STRENGTHS`; empty for no visible direction.
    """

    p_value: float
    log_evidence: float
    strength: float
    ridge: float
    rank: int
    effective: float
    gain: float
    delta_bic: float
    step: Floats
    spectrum: Spectrum | None
    noise: float
    bounded: bool = False
    by_strength: Floats = field(default_factory=lambda: np.zeros(0))

    @property
    def marginal(self) -> float:
        """Log evidence averaged over the strengths, each order of magnitude as likely a priori.

        Under no effect exp(marginal) is 1 on average; that of the best strength is more, and the
        more the more families are tried.
        """
        t = self.by_strength
        return float(np.logaddexp.reduce(t) - np.log(len(t))) if len(t) else 0.0

    @property
    def root(self) -> Floats:
        """(P, P) root of the parameters' posterior scale matrix; empty for no visible direction."""
        of = self.spectrum
        if of is None:
            return np.zeros((0, 0))
        return of.vectors * np.sqrt(self.noise / (np.where(of.seen, of.values, 0.0) + self.ridge))


NOTHING = FamilyScore(1.0, 0.0, 0.0, np.inf, 0, 0.0, 0.0, 0.0, np.zeros(0), None, 0.0)


def log_evidence(
    lam: Floats, explained: Floats, rss: float, dof: float, strengths: Floats = STRENGTHS
) -> Floats:
    """Return the log evidence (T, ...) of families at each strength τ.

    Args:
        lam: (..., P) eigenvalues of S.
        explained: (..., P) reduction of ‖r‖² by each eigenvector without a prior.
        rss: ‖r‖².
        dof: ν.
        strengths: (T,) τ.
    """
    t2 = (strengths**2 * dof / rss).reshape(-1, *(1,) * lam.ndim)
    shrunk = t2 * lam / (1 + t2 * lam)
    left = np.maximum(rss - (shrunk * explained).sum(axis=-1), ROUNDING * rss)
    return np.asarray(-0.5 * np.log1p(t2 * lam).sum(axis=-1) - 0.5 * dof * np.log(left / rss))


def _by_strength(lam: Floats, explained: Floats, rss: float, dof: float) -> tuple[Floats, Floats]:
    """`log_evidence` (T,) of one family, and prior standard deviations t σ (T,), σ² = ‖r‖²_t / ν.

    τ is t σ for the σ of the residual without the family, which holds what the family explains.
    """
    grown = np.multiply.outer(STRENGTHS**2 * (dof / rss), lam)
    grown += 1.0
    left = np.maximum(rss - (float(explained.sum()) - (1.0 / grown) @ explained), ROUNDING * rss)
    evidence = -0.5 * np.log(grown).sum(axis=1) - 0.5 * dof * np.log(left / rss)
    return evidence, STRENGTHS * np.sqrt(left / rss)


def score_family(
    s: Floats | Spectrum,
    g: Floats,
    rss: float,
    dof: float,
    spent: float = 0.0,
    most: float = np.inf,
) -> FamilyScore:
    """Score a family.

    Args:
        s: (P, P) S, or its spectrum.
        g: (P,) g.
        rss: ‖r‖².
        dof: degrees of freedom ν of r.
        spent: effective number of parameters of families with a prior that are in the model
            beside those that `dof` counts. They lower the degrees of freedom of the test; in the
            evidence their determinant has counted already, where they were added.
        most: largest plausible standard deviation of the parameters; the test does not depend on
            it.
    """
    of = s if isinstance(s, Spectrum) else spectrum(s)
    seen, rank = of.seen, of.rank
    if rank == 0 or rss <= 0 or dof - spent <= 1:
        return NOTHING
    lam, c = of.values[seen], of.along(g)[seen]
    explained = c**2 / lam
    free, small = dof - spent, rank <= LARGE_FAMILY * (dof - spent)
    if small:
        gain = min(float(explained.sum()), (1 - ROUNDING) * rss)
        rest = max((rss - gain) / (free - rank), 1e-300)
        p_value = float(f_distribution.sf(gain / rank / rest, rank, free - rank))
    else:
        p_value = ratio_tail(lam, free, float(c @ c) / rss)
    evidence, strengths = _by_strength(lam, explained, rss, dof)
    freely = int(np.argmax(evidence))
    if np.isfinite(most):
        evidence = np.where(strengths <= most, evidence, -np.inf)
        evidence[0] = max(evidence[0], -1e300)
    best = int(np.argmax(evidence))
    ridge = rss / (dof * float(STRENGTHS[best]) ** 2)
    shrunk = lam / (lam + ridge)
    effective, gain = float(shrunk.sum()), float(shrunk @ explained)
    full, count = (float(explained.sum()), rank) if small else (gain, effective)
    step = np.zeros(len(seen))
    step[seen] = shrunk * c / lam
    return FamilyScore(
        p_value=p_value,
        log_evidence=float(evidence[best]),
        strength=float(STRENGTHS[best]),
        ridge=ridge,
        rank=rank,
        effective=effective,
        gain=gain,
        delta_bic=dof * float(np.log(max(1 - full / rss, 1e-300))) + count * float(np.log(dof)),
        step=of.combined(step),
        spectrum=of,
        noise=max(rss - gain, ROUNDING * rss) / dof,
        bounded=best != freely,
        by_strength=evidence,
    )
