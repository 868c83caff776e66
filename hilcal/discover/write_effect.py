'''A law as a file with one effect, commented, that every command takes by `--effects-from`.'''

import hashlib
import sys
from types import ModuleType

import numpy as np

from hilcal.discover.law import LETTERS, Coefficient, Form
from hilcal.effects.protocol import Effect

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
{values}
        return (
{columns}
        )
'''
_RESPONSE = '''
    def response(self, theta: Floats, s: Situation, change: Floats) -> Response:
        """Change of the deviation by changes (N, P, n + 1, 6) of the wrenches, by the chain rule."""
        count, _, slots, _ = change.shape
        dq = np.zeros((len(s.angle), change.shape[1], slots - 1))
        twist = np.zeros((len(s.angle), change.shape[1], slots, 6))
{body}
        return Response(dq=dq, twist=twist)
'''


def source_of_form(
    form: Form, name: str, found: tuple[Coefficient, ...] = (), evidence: str = "", file: str = "F.py"
) -> str:
    """Return the Python file of a law.

    Args:
        form: the law.
        name: of its effect.
        found: its coefficients, for their ordinary magnitudes.
        evidence: what speaks for it, in lines.
        file: the file's own name.
    """
    scales = {c.name: _one_digit(abs(c.value)) for c in found}
    attributes = []
    if form.elastic:
        attributes.append("    elastic = True")
    if form.needs:
        attributes.append(f"    needs = ({', '.join(repr(n) for n in form.needs)},)".replace("'", '"'))
    parameters = []
    for k in range(form.count):
        where = ", ".join(dict.fromkeys(p.site.words for p in form.parts if p.coefficient == k))
        letter = LETTERS[k]
        parameters.append(
            f'            Parameter("{letter}", "{form.unit(k)}", {scales.get(letter, 1e-4)!r}, '
            f'"{where}"),'
        )
    values, columns = [], []
    for k, p in enumerate(form.parts):
        values.append(f"        by_{k} = {_product(p.amplitude.factors)}")
        columns.append(f"            {_columns(k, p)},")
    source = _HEAD.format(
        name=name,
        formula=form.text(),
        file=file,
        evidence=evidence or "Nothing is stated of its evidence.",
        imports=", Response" if form.elastic else "",
        class_name=class_name(name),
        attributes="".join(f"{a}\n" for a in attributes),
        parameters="\n".join(parameters),
        values="\n".join(values),
        columns="\n".join(columns),
    )
    if form.elastic:
        source += _RESPONSE.format(body="\n".join(_responses(form))).replace(
            "        count, _, slots, _ = change.shape\n", "        slots = change.shape[2]\n"
        )
    else:
        source = source.replace("from hilcal.types import Floats\n", "")
    return source


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


def _factor(f) -> str:  # type: ignore[no-untyped-def]
    return str(f.shape.code(f.variable.code, [repr(x) for x in f.numbers]))


def _product(factors) -> str:  # type: ignore[no-untyped-def]
    if not factors:
        return "np.ones(len(s.angle))"
    return " * ".join(f"({_factor(f)})" if len(factors) > 1 else _factor(f) for f in factors)


def _columns(k: int, p) -> str:  # type: ignore[no-untyped-def]
    index = f"np.array([{p.coefficient}]), np.array([{p.site.element}])"
    if p.site.field in ("dq", "scale"):
        return f'Columns("{p.site.field}", {index}, by_{k}[:, None])'
    axis = np.eye(6, dtype=int)[p.site.axis].tolist()
    return f'Columns("{p.site.field}", {index}, by_{k}[:, None, None] * np.array({axis}))'


def _responses(form: Form) -> list[str]:
    out = []
    for p in form.parts:
        for i, f in enumerate(p.amplitude.factors):
            if f.variable.slot is None:
                continue
            others = [g for k, g in enumerate(p.amplitude.factors) if k != i]
            slope = f.shape.slope_code(f.variable.code, [repr(x) for x in f.numbers])
            if others:
                slope = f"({slope}) * {_product(others)}" if len(others) == 1 else (
                    f"({slope}) * ({_product(others)})"
                )
                if len(others) == 1:
                    slope = f"({f.shape.slope_code(f.variable.code, [repr(x) for x in f.numbers])})"
                    slope += f" * ({_product(others)})"
            slot, component = f.variable.slot
            to = (
                f"dq[:, :, {p.site.element}]"
                if p.site.field == "dq"
                else f"twist[:, :, {p.site.element}, {p.site.axis}]"
            )
            out.append(f"        slope = theta[{p.coefficient}] * ({slope})")
            out.append(f"        {to} += slope[:, None] * change[:, :, {slot}, {component}]")
    return out


def _one_digit(x: float) -> float:
    return float(f"{x:.0e}") if x > 0 and np.isfinite(x) else 1e-4
