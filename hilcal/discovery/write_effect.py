"""A law as a file with one effect, commented, that every command takes by `--effects-from`."""

import hashlib
import sys
from collections.abc import Iterator
from types import ModuleType

import numpy as np

from hilcal.discovery.law import LETTERS, Coefficient, Form, LawPart
from hilcal.effects.check import NAME
from hilcal.effects.protocol import Effect
from hilcal.errors import InputError
from hilcal.names import escaped, quoted

USUAL = 1e-4  # Ordinary magnitude of a coefficient that nothing is known of, SI; a choice
_HEAD = '''"""`{name}`: {formula}

Proposed by `hilcal discover`; change it as you like. Every command takes it:

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
        """The coefficients; the scale is the magnitude that was found, to one digit."""
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
        """Change of the load's wrench: what acts is what was recorded less the error."""
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
    found: tuple[Coefficient, ...] = (),  # its coefficients, for their ordinary magnitudes
    evidence: str = "Nothing is stated of its evidence.",  # what speaks for it, in lines
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
        name=name,
        formula=form.text(),
        file=_in_docstring(quoted(file)),
        evidence="\n".join(map(_in_docstring, evidence.split("\n"))),
        imports=", Response" if form.elastic else "",
        class_name=class_name(name),
        attributes="".join(attributes),
        parameters="\n".join(_parameters(form, found)),
        columns="\n".join(_moving(form)),
    )
    if form.elastic:
        source += _RESPONSE.format(body="\n".join(_responses(form)))
    if any(p.site.field == "sensor" for p in form.parts):
        source += _SENSOR.format(count=form.count, body="\n".join(_misread(form)))
        names = _IMPORTED if "recorded(s)" in source else _IMPORTED.replace(", recorded", "")
        source = source.replace(_PROTOCOL, names + _PROTOCOL, 1)
    elif not form.elastic:
        source = source.replace(_FLOATS, "")
    return source


def _in_docstring(line: str) -> str:
    return escaped(line).replace("\\", "\\\\").replace('"', '\\"')


def class_name(name: str) -> str:
    """Return the name of the class of an effect."""
    return "".join(part.capitalize() for part in name.split("_"))


def effect_class(source: str, name: str) -> type[Effect]:
    """Return the effect of a source, as a file with it would give it."""
    hashed = hashlib.sha256(source.encode()).hexdigest()[:16]
    module = ModuleType(f"law_{hashed}")
    module.__file__ = f"<law {name}>"
    sys.modules[module.__name__] = module
    try:
        exec(compile(source, module.__file__, "exec"), module.__dict__)  # noqa: S102 - made above
    finally:
        del sys.modules[module.__name__]
    found: type[Effect] = module.__dict__[class_name(name)]
    return found


def _parameters(form: Form, found: tuple[Coefficient, ...]) -> Iterator[str]:
    scales = {c.name: _one_digit(abs(c.value)) for c in found}
    for k, letter in enumerate(LETTERS[: form.count]):
        where = ", ".join(dict.fromkeys(p.site.words for p in form.parts if p.coefficient == k))
        scale = scales.get(letter, USUAL)
        yield f'            Parameter("{letter}", "{form.unit(k)}", {scale!r}, "{where}"),'


def _moving(form: Form) -> Iterator[str]:
    """Yield the lines of what moves parts of the arm, or the frames."""
    parts = [(k, p) for k, p in enumerate(form.parts) if p.site.field != "sensor"]
    if not parts:
        yield "        return ()"
        return
    yield from (f"        by_{k} = {p.amplitude.code()}" for k, p in parts)
    yield "        return ("
    yield from (f"            {_columns(k, p)}," for k, p in parts)
    yield "        )"


def _misread(form: Form) -> Iterator[str]:
    """Yield the lines of what the force sensor reads beside the true wrench."""
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


def _responses(form: Form) -> Iterator[str]:
    """Yield the lines that add what each wrench component does to each part."""
    for p in form.parts:
        for (slot, component), slope in p.amplitude.slopes():
            to = f"dq[:, :, {p.site.element}]"
            if p.site.field != "dq":
                to = f"twist[:, :, {p.site.element}, {p.site.axis}]"
            yield f"        slope = theta[{p.coefficient}] * {slope}"
            yield f"        {to} += slope[:, None] * change[:, :, {slot}, {component}]"


def _one_digit(x: float) -> float:
    return float(f"{x:.0e}") if x > 0 and np.isfinite(x) else USUAL
