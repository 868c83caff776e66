"""A law in readable form: where it acts, its formula, its parameters, what speaks for it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hilcal.discovery.amplitudes import Amplitude, Factor, unit_of
from hilcal.discovery.expressions import expressions
from hilcal.discovery.screen import Screen
from hilcal.discovery.sites import ORDINARY, Site
from hilcal.discovery.terms import LawTerm
from hilcal.effects.protocol import Situation
from hilcal.types import Floats

LETTERS = "abcdefghklmnoprsuvwxyz"


@dataclass(frozen=True, slots=True)
class LawPart:
    """One product of a law: coefficient × amplitude, at one site."""

    site: Site
    amplitude: Amplitude
    coefficient: int


@dataclass(frozen=True, slots=True)
class Form:
    """A law without its numbers."""

    parts: tuple[LawPart, ...]

    @property
    def count(self) -> int:
        """Number of coefficients."""
        return 1 + max(p.coefficient for p in self.parts)

    @property
    def elastic(self) -> bool:
        """Whether it depends on transmitted wrenches."""
        return any(p.amplitude.elastic for p in self.parts)

    @property
    def of_setup(self) -> bool:
        """Whether all of it is of how a campaign was set up, not of the arm."""
        return all(p.site.of_setup for p in self.parts)

    @property
    def needs(self) -> tuple[str, ...]:
        """Columns of the readings that it needs."""
        return tuple(dict.fromkeys(n for p in self.parts for n in p.amplitude.needs))

    @property
    def variables(self) -> tuple[str, ...]:
        """What it depends on, as the diagnosis calls it."""
        return tuple(dict.fromkeys(n for p in self.parts for n in p.amplitude.names))

    @property
    def acts_on(self) -> tuple[str, ...]:
        """Where it acts."""
        return tuple(dict.fromkeys(p.site.words for p in self.parts))

    @property
    def complexity(self) -> int:
        """Coefficients, and complexity of the amplitudes that they multiply."""
        return self.count + sum(p.amplitude.cost for p in self.parts)

    def unit(self, coefficient: int) -> str:
        """Unit of a coefficient."""
        part = next(p for p in self.parts if p.coefficient == coefficient)
        site, powers = part.site.unit, dict(part.amplitude.powers)
        if part.site.field == "sensor" and site in powers:
            # A force by a force; an angle by an angle is left as people write it.
            left = powers.pop(site) - 1.0
            powers |= {site: left} if left > 0 else {}
            site = "1" if left >= 0 else unit_of({site: -left})
        inner = unit_of(powers)
        if inner == "1":
            return site
        wrapped = f"({inner})" if "·" in inner or "^" in inner else inner
        return f"{site}/{wrapped}"

    def text(self) -> str:
        """Return the formula as plain text, one equation per site."""
        return "; ".join(
            f"{symbol} = {' + '.join(terms)}"
            for symbol, terms in self._equations(lambda s: s.symbol, _amplitude_text).items()
        )

    def latex(self) -> str:
        """Return the formula in LaTeX."""
        return r",\quad ".join(
            f"{symbol} = {' + '.join(terms)}"
            for symbol, terms in self._equations(lambda s: s.latex, _amplitude_latex).items()
        )

    def _equations(
        self, symbol: Callable[[Site], str], write: Callable[[str, Amplitude], str]
    ) -> dict[str, list[str]]:
        out: dict[str, list[str]] = {}
        for p in self.parts:
            out.setdefault(symbol(p.site), []).append(write(LETTERS[p.coefficient], p.amplitude))
        return out

    def motion(self, sites: tuple[Site, ...], motion: Floats, s: Situation) -> Floats:
        """(N, m, P) motion of each reading, by ordinary motions (N, m, S) of the sites."""
        out = np.zeros((*motion.shape[:2], self.count))
        for p in self.parts:
            by = p.amplitude.values(s)[:, None]
            out[:, :, p.coefficient] += motion[:, :, sites.index(p.site)] * by
        return out

    def columns(self, screen: Screen, s: Situation) -> Floats:
        """(R, P) whitened columns by ordinary motions, at the fit of a screen."""
        w = screen.linear.fit.whitening
        return w.whiten_readings(self.motion(screen.sites, screen.motion, s))


def _amplitude_text(letter: str, a: Amplitude) -> str:
    return f"{letter}·{a.text()}" if a.factors else letter


def _amplitude_latex(letter: str, a: Amplitude) -> str:
    return rf"{letter}\,{a.latex()}" if a.factors else letter


def form_of(screen: Screen, terms: tuple[LawTerm, ...]) -> Form:
    """Return the law of chosen terms."""
    parts: list[LawPart] = []
    count = 0
    for t in terms:
        for k, (site, amplitude) in enumerate(t.parts):
            at = count if t.common else count + k
            parts.append(LawPart(screen.sites[site], screen.grammar.at(amplitude), at))
        count += 1 if t.common else len(t.parts)
    return Form(tuple(parts))


def with_factors(form: Form, factors: dict[tuple[int, int], Factor]) -> Form:
    """Return a law with other factors, by part and place in its product."""
    parts = []
    for k, p in enumerate(form.parts):
        own = tuple(factors.get((k, i), f) for i, f in enumerate(p.amplitude.factors))
        parts.append(replace(p, amplitude=Amplitude(own)))
    return Form(tuple(parts))


def with_coefficients(form: Form, kept: Sequence[int]) -> Form:
    """Return a law with some of its coefficients, in their order; the others are zero."""
    at = {old: new for new, old in enumerate(kept)}
    parts = (replace(p, coefficient=at[p.coefficient]) for p in form.parts if p.coefficient in at)
    return Form(tuple(parts))


def ordinary(form: Form) -> Floats:
    """(P,) motions that one unit of the whitened columns' coefficients stands for."""
    out = np.ones(form.count)
    for p in form.parts:
        out[p.coefficient] = ORDINARY[p.site.unit]
    return out


@dataclass(frozen=True, slots=True)
class Coefficient:
    """A parameter of a law."""

    name: str
    value: float
    std: float
    unit: str


def coefficients(form: Form, step: Floats, std: Floats) -> tuple[Coefficient, ...]:
    """Return the coefficients of a law, SI, from (P,) means and uncertainties, ordinary motions."""
    size = ordinary(form)
    return tuple(
        Coefficient(LETTERS[k], float(v), float(e), form.unit(k))
        for k, (v, e) in enumerate(zip(step * size, std * size, strict=True))
    )


@dataclass(frozen=True, slots=True)
class Again:
    """How often a cause was found again."""

    acts_on: str
    variables: tuple[str, ...]  # the quantities that move it
    share: float  # share of the searches without some poses that find the same


@dataclass(frozen=True, slots=True)
class Resemblance:
    """An effect of the catalogue, and how near a law is to what it can describe."""

    effect: str
    cosine: float  # correlation of the law with what the effect predicts of it on poses left out


@dataclass(frozen=True, eq=False)
class Law:
    """A law that the readings speak for."""

    name: str  # of its effect
    form: Form  # where it acts, and how
    parameters: tuple[Coefficient, ...]
    # of the joint test of its columns, times the number of candidates that were tried
    p_value: float
    odds: float  # logarithm of the odds against no law, the search paid for
    holdout_share: float  # share of the misfit that it explains on poses left out
    left: float  # variance factor that is left
    probability: float  # posterior, of its structure
    resembles: tuple[Resemblance, ...]  # effects of the catalogue that are near, the nearest first
    # least and largest of each quantity in the readings
    ranges: tuple[tuple[str, float, float, str], ...]
    # for each site and its quantities, the share of them that find these
    again: tuple[Again, ...] = ()

    @property
    def formula(self) -> str:
        """The formula as plain text."""
        return self.form.text()

    @property
    def expressions(self) -> dict[str, str]:
        """Its value at each site as arithmetic of named quantities; see `expressions`."""
        return expressions(self)

    @property
    def acts_on(self) -> tuple[str, ...]:
        """Where it acts."""
        return self.form.acts_on

    @property
    def variables(self) -> tuple[str, ...]:
        """What it depends on."""
        return self.form.variables
