"""A law in readable form: its sites, formula, parameters and evidence."""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hilcal.discovery.amplitudes import Amplitude, Factor, unit_of
from hilcal.discovery.screen import LawTerm, Screen
from hilcal.discovery.sites import ORDINARY, Site
from hilcal.effects.catalogue import effects_of
from hilcal.effects.check import NAME
from hilcal.effects.protocol import Effect, Situation
from hilcal.errors import InputError
from hilcal.names import escaped, quoted
from hilcal.types import Floats

_QUANTITIES = {"angle": "q", "torque": "tau"}
_JOINT = re.compile(r"s\.(angle|torque)\[:, (\d+)(?::(\d+))?\](\.sum\(axis=1\))?")
_FORCE = re.compile(r"np\.linalg\.norm\(s\.states\.wrench\[:, 0:3\], axis=1\)")
_RECORDED = re.compile(r"s\.states\.(time|air)(?:_temperature)?|np\.")
_OTHER = re.compile(r"\bs\.|\brecorded\(|\bwhere\(|\bhypot\(|\[")


def _joints(m: re.Match[str]) -> str:
    first, last = int(m[2]), int(m[3] or int(m[2]) + 1)
    return "(" + " + ".join(f"{_QUANTITIES[m[1]]}{j + 1}" for j in range(first, last)) + ")"


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
        """Whether the law depends on transmitted wrenches."""
        return any(p.amplitude.elastic for p in self.parts)

    @property
    def of_setup(self) -> bool:
        """Whether the whole law belongs to the setup of a campaign, not to the arm."""
        return all(p.site.of_setup for p in self.parts)

    @property
    def needs(self) -> tuple[str, ...]:
        """Columns of the readings that the law needs."""
        return tuple(dict.fromkeys(n for p in self.parts for n in p.amplitude.needs))

    @property
    def variables(self) -> tuple[str, ...]:
        """Names of its quantities in the diagnosis."""
        return tuple(dict.fromkeys(n for p in self.parts for n in p.amplitude.names))

    @property
    def acts_on(self) -> tuple[str, ...]:
        """Its sites, in words."""
        return tuple(dict.fromkeys(p.site.words for p in self.parts))

    @property
    def complexity(self) -> int:
        """Number of coefficients plus complexity of the amplitudes."""
        return self.count + sum(p.amplitude.cost for p in self.parts)

    def unit(self, coefficient: int) -> str:
        """Unit of a coefficient."""
        part = next(p for p in self.parts if p.coefficient == coefficient)
        site, powers = part.site.unit, dict(part.amplitude.powers)
        if part.site.field == "sensor" and site in powers:
            # a force cancels a force; rad per rad is written
            power = powers.pop(site) - 1.0
            powers |= {site: power} if power > 0 else {}
            site = "1" if power >= 0 else unit_of({site: -power})
        inner = unit_of(powers)
        if inner == "1":
            return site
        wrapped = f"({inner})" if "·" in inner or "^" in inner else inner
        return f"{site}/{wrapped}"

    def text(self) -> str:
        """Return the formula as plain text, one equation per site."""
        return "; ".join(self._equations("symbol", "·", Amplitude.text))

    def latex(self) -> str:
        """Return the formula in LaTeX."""
        return r",\quad ".join(self._equations("latex", r"\,", Amplitude.latex))

    def _equations(self, symbol: str, times: str, write: Callable[[Amplitude], str]) -> list[str]:
        out: dict[str, list[str]] = {}
        for p in self.parts:
            letter, inner = LETTERS[p.coefficient], write(p.amplitude)
            term = f"{letter}{times}{inner}" if inner else letter
            out.setdefault(getattr(p.site, symbol), []).append(term)
        return [f"{symbol} = {' + '.join(terms)}" for symbol, terms in out.items()]

    def motion(self, sites: tuple[Site, ...], motion: Floats, s: Situation) -> Floats:
        """(N, m, P) motion of readings by unit coefficients, from motions (N, m, S) of sites."""
        out = np.zeros((*motion.shape[:2], self.count))
        for p in self.parts:
            amplitude = p.amplitude.values(s)[:, None]
            out[:, :, p.coefficient] += motion[:, :, sites.index(p.site)] * amplitude
        return out

    def columns(self, screen: Screen, s: Situation) -> Floats:
        """(R, P) whitened columns of the coefficients, in ordinary motions, at the screen's fit."""
        w = screen.linear.fit.whitening
        return w.whiten_readings(self.motion(screen.sites, screen.motion, s))


def form_of(screen: Screen, terms: tuple[LawTerm, ...]) -> Form:
    """Return the law of chosen terms."""
    parts: list[LawPart] = []
    count = 0
    for t in terms:
        for k, (site, amplitude) in enumerate(t.parts):
            coefficient = count if t.common else count + k
            parts.append(
                LawPart(screen.sites[site], screen.grammar.amplitude(amplitude), coefficient)
            )
        count += 1 if t.common else len(t.parts)
    return Form(tuple(parts))


def with_factors(form: Form, factors: dict[tuple[int, int], Factor]) -> Form:
    """Return a law with other factors, by (part, index in its product)."""
    parts = []
    for k, p in enumerate(form.parts):
        replaced = tuple(factors.get((k, i), f) for i, f in enumerate(p.amplitude.factors))
        parts.append(replace(p, amplitude=Amplitude(replaced)))
    return Form(tuple(parts))


def with_coefficients(form: Form, retained: Sequence[int]) -> Form:
    """Return a law with some of its coefficients, in this order; the others are dropped."""
    new = {old: k for k, old in enumerate(retained)}
    parts = (replace(p, coefficient=new[p.coefficient]) for p in form.parts if p.coefficient in new)
    return Form(tuple(parts))


@dataclass(frozen=True, slots=True)
class Coefficient:
    """A parameter of a law."""

    name: str
    value: float
    std: float
    unit: str


def coefficients(form: Form, step: Floats, std: Floats) -> tuple[Coefficient, ...]:
    """Return coefficients in SI from means and stds (P,) in ordinary motions."""
    size = np.ones(form.count)
    for p in form.parts:
        size[p.coefficient] = ORDINARY[p.site.unit]
    return tuple(
        Coefficient(LETTERS[k], float(v), float(e), form.unit(k))
        for k, (v, e) in enumerate(zip(step * size, std * size, strict=True))
    )


@dataclass(frozen=True, slots=True)
class SelectionFrequency:
    """Share of the searches without a fold that found a cause again."""

    acts_on: str
    variables: tuple[str, ...]  # quantities that move it
    share: float  # of the searches without some poses


@dataclass(frozen=True, slots=True)
class Resemblance:
    """An effect of the catalogue, and how well it describes a law."""

    effect: str
    cosine: float  # of the law with the effect's prediction of it on poses left out


@dataclass(frozen=True, eq=False)
class Law:
    """A law that the readings support."""

    name: str  # of its effect
    form: Form
    parameters: tuple[Coefficient, ...]
    p_value: float  # of the joint test of its columns, times the number of candidates
    odds: float  # logarithm of the odds against no law, corrected for the size of the search
    holdout_share: float  # share of the misfit that it explains on poses left out
    variance_factor: float  # of the fit with the law
    probability: float  # posterior, of its structure
    resembles: tuple[Resemblance, ...]  # effects of the catalogue that are near, the nearest first
    ranges: tuple[tuple[str, float, float, str], ...]  # of each quantity in the readings
    selection_frequencies: tuple[SelectionFrequency, ...] = ()  # of each site, its quantities

    @property
    def formula(self) -> str:
        """The formula as plain text."""
        return self.form.text()

    @property
    def expressions(self) -> dict[str, str]:
        """Its value by site as plain arithmetic, in the site's unit.

        E.g. {"dq_3": "0.0002*(sin(3 * q4))"}. Quantities are `q1` … (rad), `tau1` … (torques of the
        drives, N·m), `force` (of the load, N), `time` (s) and `air` (air temperature, °C).
        Operators are Python's, functions have numpy's names, except `max`. Sites that need more are
        left out.
        """
        terms: dict[str, list[str]] = {}
        for p in self.form.parts:
            value = self.parameters[p.coefficient].value
            terms.setdefault(p.site.symbol, []).append(f"{value!r}*({p.amplitude.code()})")
        plain = {}
        for symbol, summands in terms.items():
            text = " + ".join(summands).replace("np.ones(len(s.angle))", "1.0")
            text = _JOINT.sub(_joints, text.replace("np.maximum", "max"))
            plain[symbol] = _RECORDED.sub(lambda m: m[1] or "", _FORCE.sub("force", text))
        return {symbol: text for symbol, text in plain.items() if not _OTHER.search(text)}

    @property
    def acts_on(self) -> tuple[str, ...]:
        """Its sites, in words."""
        return self.form.acts_on

    @property
    def variables(self) -> tuple[str, ...]:
        """Names of its quantities."""
        return self.form.variables


ORDINARY_COEFFICIENT = 1e-4  # Ordinary magnitude of an unknown coefficient, SI; a choice
PROPOSED = "Proposed by `hilcal discover`"  # in the head of every file of a law
_HEAD = '''"""`{name}`: {formula}

{proposed}; edit it as you like. Every command can use it:

    hilcal effects --effects-from {file}
    hilcal add RUN.hilcal {name} --effects-from {file}
    hilcal diagnose RUN.hilcal --effects-from {file}

{evidence}

All is in SI units: m, rad, N, N·m, s; temperatures in °C. N is the number of states, n that of
joints.
"""

import numpy as np

from hilcal.effects.protocol import Columns, Effect, Parameter{imports}, Situation
from hilcal.types import Floats


class {class_name}(Effect):
    """{formula}"""

    name = "{name}"
    summary = "{formula}"
{attributes}
    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The coefficients; the scale is the estimated magnitude, to one digit."""
        return (
{parameters}
        )

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Derivative of the deviation by the coefficients."""
{columns}
'''
_RESPONSE = '''
    def response(self, theta: Floats, s: Situation, change: Floats) -> Response:
        """Change of the deviation by changes (N, P, n + 1, 6) of the wrenches: the chain rule."""
        slots = change.shape[2]
        dq = np.zeros((len(s.angle), change.shape[1], slots - 1))
        twist = np.zeros((len(s.angle), change.shape[1], slots, 6))
{body}
        return Response(dq=dq, twist=twist)
'''
_SENSOR = '''
    def sensor_columns(self, s: Situation) -> Floats:
        """Derivative of the force sensor's error by the coefficients, flange axes."""
        out = np.zeros((len(s.angle), {count}, 6))
{body}
        return out

    def wrench_change(self, theta: Floats, s: Situation) -> Floats:
        """Change of the load's wrench: the acting wrench is the recorded one minus the error."""
        return acting_change(s, np.einsum("npc,p->nc", self.sensor_columns(s), theta))

    def wrench_columns(self, theta: Floats, s: Situation) -> Floats:
        """Derivative of the wrenches through the arm by the coefficients."""
        return acting_columns(s, self.sensor_columns(s))
'''
_IMPORTED = "from hilcal.effects.force_sensor import acting_change, acting_columns, recorded\n"
_PROTOCOL = "from hilcal.effects.protocol"
_FLOATS = "from hilcal.types import Floats\n"


def source_of_form(
    form: Form,
    name: str,
    values: tuple[Coefficient, ...] = (),  # for ordinary magnitudes
    evidence: str = "Its evidence is not stated.",  # lines for its docstring
    file: str = "F.py",
) -> str:
    """Return the Python file of a law."""
    if not NAME.fullmatch(name):
        raise InputError(f"effect {escaped(name)!r}; valid: lower-case letters, digits and _")
    attributes = ["    elastic = True\n"] if form.elastic else []
    if form.of_setup:
        attributes.append("    of_setup = True\n")
    if form.needs:
        needs = "".join(f'"{n}", ' for n in form.needs).rstrip()
        attributes.append(f"    needs = ({needs})\n")
    source = _HEAD.format(
        name=name, formula=form.text(), proposed=PROPOSED, file=_in_docstring(quoted(file)),
        evidence="\n".join(map(_in_docstring, evidence.split("\n"))),
        imports=", Response" if form.elastic else "",
        class_name="".join(part.capitalize() for part in name.split("_")),
        attributes="".join(attributes), parameters="\n".join(_parameters(form, values)),
        columns="\n".join(_column_code(form)),
    )  # fmt: skip
    if form.elastic:
        source += _RESPONSE.format(body="\n".join(_response_code(form)))
    if any(p.site.field == "sensor" for p in form.parts):
        source += _SENSOR.format(count=form.count, body="\n".join(_sensor_code(form)))
        names = _IMPORTED if "recorded(s)" in source else _IMPORTED.replace(", recorded", "")
        source = source.replace(_PROTOCOL, names + _PROTOCOL, 1)
    elif not form.elastic:
        source = source.replace(_FLOATS, "")
    return source


def _in_docstring(line: str) -> str:
    return escaped(line).replace("\\", "\\\\").replace('"', '\\"')


def effect_class(source: str, name: str) -> type[Effect]:
    """Return the effect of a source, as if from a file."""
    return effects_of(source.encode(), Path(f"<law {name}>")).effects[0]


def _parameters(form: Form, values: tuple[Coefficient, ...]) -> Iterator[str]:
    size = {c.name: abs(c.value) for c in values}
    scales = {k: float(f"{x:.0e}") for k, x in size.items() if x > 0 and np.isfinite(x)}
    for k, letter in enumerate(LETTERS[: form.count]):
        sites = ", ".join(dict.fromkeys(p.site.words for p in form.parts if p.coefficient == k))
        scale = scales.get(letter, ORDINARY_COEFFICIENT)
        yield f'            Parameter("{letter}", "{form.unit(k)}", {scale!r}, "{sites}"),'


def _column_code(form: Form) -> Iterator[str]:
    parts = [(k, p) for k, p in enumerate(form.parts) if p.site.field != "sensor"]
    if not parts:
        yield "        return ()"
        return
    yield from (f"        by_{k} = {p.amplitude.code()}" for k, p in parts)
    yield "        return ("
    yield from (f"            {_columns(k, p)}," for k, p in parts)
    yield "        )"


def _sensor_code(form: Form) -> Iterator[str]:
    for p in form.parts:
        if p.site.field == "sensor":
            yield f"        by = {p.amplitude.code()}"
            yield f"        out[:, {p.coefficient}, {p.site.axis}] += by"


def _columns(k: int, p: LawPart) -> str:
    index = f"np.array([{p.coefficient}]), np.array([{p.site.element}])"
    if p.site.field in ("dq", "scale"):
        return f'Columns("{p.site.field}", {index}, by_{k}[:, None])'
    axis = np.eye(6, dtype=int)[p.site.axis].tolist()
    return f'Columns("{p.site.field}", {index}, by_{k}[:, None, None] * np.array({axis}))'


def _response_code(form: Form) -> Iterator[str]:
    for p in form.parts:
        for (slot, component), slope in p.amplitude.slopes():
            target = f"dq[:, :, {p.site.element}]"
            if p.site.field != "dq":
                target = f"twist[:, :, {p.site.element}, {p.site.axis}]"
            yield f"        slope = theta[{p.coefficient}] * {slope}"
            yield f"        {target} += slope[:, None] * change[:, :, {slot}, {component}]"
