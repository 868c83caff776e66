"""Laws as arithmetic that other programs read: names of quantities, numbers and functions alone."""

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hilcal.discovery.law import Law

_QUANTITIES = {"angle": "q", "torque": "tau"}
_JOINT = re.compile(r"s\.(angle|torque)\[:, (\d+)(?::(\d+))?\](\.sum\(axis=1\))?")
_FORCE = re.compile(r"np\.linalg\.norm\(s\.states\.wrench\[:, 0:3\], axis=1\)")
_RECORDED = re.compile(r"s\.states\.(time|air)(?:_temperature)?|np\.")
_OTHER = re.compile(r"\bs\.|\brecorded\(|\bwhere\(|\bhypot\(|\[")


def expressions(law: "Law") -> dict[str, str]:
    """Return the value of a law at each site where plain arithmetic says it.

    Quantities are `q1` ... (rad), `tau1` ... (torques of the drives, N·m), `force` (of the load,
    N), `time` (s) and `air` (air temperature, °C); operators are Python's, functions have numpy's
    names, but for `max`. A site whose law depends on anything else, or has branches, is left out.

    law: as it was discovered.

    Returns:
        By the site's symbol in formulas, e.g. {"dq_3": "0.0002*(sin(3 * q4))"}, in the site's unit.
    """
    terms: dict[str, list[str]] = {}
    for p in law.form.parts:
        value = law.parameters[p.coefficient].value
        terms.setdefault(p.site.symbol, []).append(f"{value!r}*({p.amplitude.code()})")
    plain = {symbol: _plain(" + ".join(own)) for symbol, own in terms.items()}
    return {symbol: text for symbol, text in plain.items() if not _OTHER.search(text)}


def _plain(code: str) -> str:
    """Return the code of an effect with its quantities by name; what has none stays."""
    text = code.replace("np.ones(len(s.angle))", "1.0").replace("np.maximum", "max")
    text = _JOINT.sub(_joints, text)
    return _RECORDED.sub(lambda m: m[1] or "", _FORCE.sub("force", text))


def _joints(m: re.Match[str]) -> str:
    first, last = int(m[2]), int(m[3] or int(m[2]) + 1)
    return "(" + " + ".join(f"{_QUANTITIES[m[1]]}{j + 1}" for j in range(first, last)) + ")"
