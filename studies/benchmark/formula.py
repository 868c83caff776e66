"""Formulas of laws: read safely, evaluated, and compared with the truth; numpy alone.

A formula is an arithmetic expression of numbers and of a task's quantities, e.g.
"0.001*sin(3*q4) + 2e-6*tau2**2".
"""

import ast
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

FUNCTIONS: dict[str, tuple[Any, int]] = {
    **{name: (getattr(np, name), 1) for name in ("sin", "cos", "tan", "tanh", "arctan")},
    **{name: (getattr(np, name), 1) for name in ("exp", "log", "sqrt", "abs", "sign")},
    "max": (np.maximum, 2),
    "min": (np.minimum, 2),
}
"""Functions of a formula, and their numbers of arguments."""
_OPERATORS: dict[type[ast.operator], Any] = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.divide,
    ast.Pow: np.power,
}
_LONGEST, _DEEPEST = 2000, 60
MOST_CONSTANTS = 10
"""A formula of more numbers is not compared by form: it would fit any law."""
EQUIVALENT = 0.01
"""Largest deviation of an equivalent formula, as a share of the law's largest value."""
_ROUNDS = 200
_STEP = 1e-6  # of a constant, for its derivative


class FormulaError(ValueError):
    """A formula that cannot be read; the message is one line."""


@dataclass(frozen=True, slots=True)
class Formula:
    """An expression whose numbers can be replaced.

    Attributes:
        text: as it was written.
        constants: its numbers from left to right; whole exponents and pi are no constants.
    """

    text: str
    constants: tuple[float, ...]
    _tree: ast.expr

    @classmethod
    def parse(cls, text: object, names: Mapping[str, object]) -> "Formula":
        """Read a formula of the named quantities.

        Raises:
            FormulaError: what is not such an expression.
        """
        if not isinstance(text, str) or not 0 < len(text) <= _LONGEST:
            raise FormulaError(f"formula: valid is a text of 1 to {_LONGEST} characters")
        try:
            tree = ast.parse(text.strip(), mode="eval").body
            constants = tuple(_checked(tree, {*names, "pi"}))
        except (SyntaxError, ValueError, OverflowError, RecursionError, MemoryError) as error:
            what = " ".join(str(error).split())
            raise FormulaError(f"formula {text[:80]!r}: {what}") from error
        return cls(text, constants, tree)

    @property
    def variables(self) -> set[str]:
        """Names of the quantities in it."""
        named = {node.id for node in ast.walk(self._tree) if isinstance(node, ast.Name)}
        return named - {*FUNCTIONS, "pi"}

    def value(self, columns: Mapping[str, Floats], constants: Floats | None = None) -> Floats:
        """Return its (N,) values at the columns (N,) of the quantities; not finite where undefined.

        Args:
            columns: quantities by name.
            constants: in the place of its own.
        """
        numbers = iter(self.constants if constants is None else constants.tolist())
        rows = next(iter(columns.values())).shape
        with np.errstate(all="ignore"):
            out = _value(self._tree, columns, numbers)
        return np.array(np.broadcast_to(out, rows), dtype=float)


def _checked(node: ast.expr, names: set[str], depth: int = 0) -> Iterator[float]:
    """Yield the constants, and refuse everything else that is not valid."""
    if depth > _DEEPEST:
        raise FormulaError(f"nested more than {_DEEPEST} deep")
    match node:
        case ast.Constant(value=bool() | complex() | str() | bytes() | None):
            raise FormulaError(f"{ast.unparse(node)} is no number")
        case ast.Constant(value=int() | float() as number):
            yield float(number)
        case ast.Name(id=name):
            if name not in names:
                raise FormulaError(f"{name} is no quantity; valid: {', '.join(sorted(names))}")
        case ast.UnaryOp(op=ast.USub() | ast.UAdd(), operand=inner):
            yield from _checked(inner, names, depth + 1)
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
            yield from _checked(left, names, depth + 1)
            if not _whole_exponent(node):
                yield from _checked(right, names, depth + 1)
        case ast.Call(func=ast.Name(id=name), args=given, keywords=[]) if name in FUNCTIONS:
            if len(given) != FUNCTIONS[name][1]:
                raise FormulaError(f"{name} takes {FUNCTIONS[name][1]} argument(s)")
            for each in given:
                yield from _checked(each, names, depth + 1)
        case _:
            valid = f"+ - * / **, {', '.join(FUNCTIONS)}, numbers and the task's quantities"
            raise FormulaError(f"{ast.unparse(node)[:40]!r} is not allowed; valid: {valid}")


def _whole_exponent(node: ast.BinOp) -> bool:
    """Whether it is a power by a whole number: part of the form, not a constant."""
    right = node.right
    if isinstance(right, ast.UnaryOp):
        right = right.operand
    return (
        isinstance(node.op, ast.Pow)
        and isinstance(right, ast.Constant)
        and type(right.value) in (int, float)
        and float(right.value).is_integer()  # type: ignore[arg-type]
    )


def _value(node: ast.expr, columns: Mapping[str, Floats], numbers: Iterator[float]) -> Any:
    match node:
        case ast.Constant():
            return np.float64(next(numbers))
        case ast.Name(id=name):
            return np.float64(np.pi) if name == "pi" and name not in columns else columns[name]
        case ast.UnaryOp(op=op, operand=inner):
            inside = _value(inner, columns, numbers)
            return -inside if isinstance(op, ast.USub) else inside
        case ast.BinOp(left=left, op=operator, right=right):
            first = _value(left, columns, numbers)
            whole = _whole_exponent(node)
            second = float(ast.literal_eval(right)) if whole else _value(right, columns, numbers)
            return _OPERATORS[type(operator)](first, second)
        case ast.Call(func=ast.Name(id=name), args=given):
            return FUNCTIONS[name][0](*(_value(each, columns, numbers) for each in given))
    raise FormulaError("an expression that was not checked")


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """A law that was found beside the true one, at N states.

    What a joint's zero and its compliance can stand for is no part of a law: a constant and, where
    it acts on joint j, a multiple of tau_j. Both values are compared with these projected out.

    Attributes:
        found: the formula that was found.
        true: the law.
        columns: (N,) quantities by name.
        acts_on: "q1" to "q6", or another site.
    """

    found: Formula
    true: Formula
    columns: Mapping[str, Floats]
    acts_on: str

    def _own(self, values: Floats) -> Floats:
        beside = [np.ones(len(values))]
        if self.acts_on.startswith("q"):
            beside.append(self.columns[f"tau{self.acts_on[1:]}"])
        basis = np.linalg.qr(np.column_stack(beside))[0]
        with np.errstate(all="ignore"):
            return np.asarray(values - basis @ (basis.T @ values))

    def error(self) -> float:
        """Return rms(f - f_true) / rms(f_true); infinite where f is undefined."""
        true = self._own(self.true.value(self.columns))
        off = self._own(self.found.value(self.columns)) - true
        ratio = float(np.sqrt(np.mean(off**2) / np.mean(true**2)))
        return ratio if np.isfinite(ratio) else float("inf")

    def equivalent(self) -> bool:
        """Whether g f(constants), all refitted, agrees with the law to 1 % at every state.

        It has to be of the same quantities, so that a term that would have to vanish counts as
        wrong. Levenberg-Marquardt from the formula's own constants.
        """
        true = self._own(self.true.value(self.columns))
        true /= np.abs(true).max()
        beside = {f"tau{self.acts_on[1:]}"}
        if len(self.found.constants) > MOST_CONSTANTS or (
            self.found.variables - beside != self.true.variables - beside
        ):
            return False

        def off(theta: Floats) -> Floats:
            found = self.found.value(self.columns, theta[1:])
            return np.asarray(theta[0] * self._own(found) - true)

        own = self._own(self.found.value(self.columns))
        size = float(own @ own)
        if not np.isfinite(size) or size == 0.0:
            return False
        theta = np.array([float(own @ true) / size, *self.found.constants])
        r, damping = off(theta), 1e-3
        for _ in range(_ROUNDS):
            step = _STEP * np.maximum(np.abs(theta), 1e-6)
            J = np.column_stack([(off(theta + h) - r) / h.sum() for h in np.diag(step)])
            if not np.all(np.isfinite(J)) or np.abs(r).max() < 0.1 * EQUIVALENT:
                break
            scale = np.sqrt((J**2).sum(axis=0)) + 1e-300
            A = np.vstack([J / scale, np.sqrt(damping) * np.eye(len(theta))])
            move = np.linalg.lstsq(A, -np.append(r, np.zeros(len(theta))), rcond=None)[0] / scale
            tried = off(theta + move)
            with np.errstate(over="ignore"):  # a step too far
                better = bool(np.all(np.isfinite(tried)) and tried @ tried < r @ r)
            if better:
                theta, r, damping = theta + move, tried, max(damping / 5.0, 1e-12)
            elif (damping := 5.0 * damping) > 1e8:
                break
        return bool(np.abs(r).max() <= EQUIVALENT)
