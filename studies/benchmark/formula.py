"""Formulas of laws: safe parsing, evaluation, and comparison with the truth; needs only numpy.

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
"""A formula with more constants is not equivalent: it could fit any law."""
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
        text: as written.
        constants: numbers from left to right, without whole exponents and pi.
    """

    text: str
    constants: tuple[float, ...]
    _tree: ast.expr

    @classmethod
    def parse(cls, text: object, names: Mapping[str, object]) -> "Formula":
        """Read a formula of the named quantities.

        Raises:
            FormulaError: the text is no such expression.
        """
        if not isinstance(text, str) or not 0 < len(text) <= _LONGEST:
            raise FormulaError(f"formula: valid is a text of 1 to {_LONGEST} characters")
        try:
            tree = ast.parse(text.strip(), mode="eval").body
            constants = tuple(_checked(tree, {*names, "pi"}))
        except (SyntaxError, ValueError, OverflowError, RecursionError, MemoryError) as error:
            reason = " ".join(str(error).split())
            raise FormulaError(f"formula {text[:80]!r}: {reason}") from error
        return cls(text, constants, tree)

    @property
    def variables(self) -> set[str]:
        """Names of the quantities in the formula."""
        named = {node.id for node in ast.walk(self._tree) if isinstance(node, ast.Name)}
        return named - {*FUNCTIONS, "pi"}

    def value(self, columns: Mapping[str, Floats], constants: Floats | None = None) -> Floats:
        """Return the values (N,), not finite where undefined.

        Args:
            columns: (N,) quantities by name.
            constants: replace those of the formula.
        """
        numbers = iter(self.constants if constants is None else constants.tolist())
        rows = next(iter(columns.values())).shape
        with np.errstate(all="ignore"):
            out = _value(self._tree, columns, numbers)
        return np.array(np.broadcast_to(out, rows), dtype=float)


def _checked(node: ast.expr, names: set[str], depth: int = 0) -> Iterator[float]:
    """Yield the constants, and refuse invalid parts."""
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
        case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]) if name in FUNCTIONS:
            if len(arguments) != FUNCTIONS[name][1]:
                raise FormulaError(f"{name} takes {FUNCTIONS[name][1]} argument(s)")
            for argument in arguments:
                yield from _checked(argument, names, depth + 1)
        case _:
            valid = f"+ - * / **, {', '.join(FUNCTIONS)}, numbers and the task's quantities"
            raise FormulaError(f"{ast.unparse(node)[:40]!r} is not allowed; valid: {valid}")


def _whole_exponent(node: ast.BinOp) -> bool:
    """Whether a node is a power with a whole exponent, which is part of the form, no constant."""
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
        case ast.Call(func=ast.Name(id=name), args=arguments):
            return FUNCTIONS[name][0](*(_value(a, columns, numbers) for a in arguments))
    raise FormulaError("an expression that was not checked")


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Comparison of a proposed formula with the true law at N states.

    A joint's zero and compliance absorb a constant and, for a law of joint j, a multiple of tau_j.
    These are projected out of both values.

    Attributes:
        found: the proposed formula.
        true: the law.
        columns: (N,) quantities by name.
        acts_on: "q1" to "q6", or another site.
    """

    found: Formula
    true: Formula
    columns: Mapping[str, Floats]
    acts_on: str

    def _projected(self, values: Floats) -> Floats:
        absorbed = [np.ones(len(values))]
        if self.acts_on.startswith("q"):
            absorbed.append(self.columns[f"tau{self.acts_on[1:]}"])
        basis = np.linalg.qr(np.column_stack(absorbed))[0]
        with np.errstate(all="ignore"):
            return np.asarray(values - basis @ (basis.T @ values))

    def error(self) -> float:
        """Return rms(f - f_true) / rms(f_true); infinite where f is undefined."""
        true = self._projected(self.true.value(self.columns))
        error = self._projected(self.found.value(self.columns)) - true
        ratio = float(np.sqrt(np.mean(error**2) / np.mean(true**2)))
        return ratio if np.isfinite(ratio) else float("inf")

    def equivalent(self) -> bool:
        """Whether g f(constants), with refitted g and constants, is the law to 1 % at every state.

        Both must have the same quantities, so that a formula with a superfluous term is wrong. The
        fit is Levenberg-Marquardt's, from the formula's constants.
        """
        true = self._projected(self.true.value(self.columns))
        true /= np.abs(true).max()
        absorbed = {f"tau{self.acts_on[1:]}"}
        if len(self.found.constants) > MOST_CONSTANTS or (
            self.found.variables - absorbed != self.true.variables - absorbed
        ):
            return False

        def residual(theta: Floats) -> Floats:
            values = self.found.value(self.columns, theta[1:])
            return np.asarray(theta[0] * self._projected(values) - true)

        proposed = self._projected(self.found.value(self.columns))
        size = float(proposed @ proposed)
        if not np.isfinite(size) or size == 0.0:
            return False
        theta = np.array([float(proposed @ true) / size, *self.found.constants])
        r, damping = residual(theta), 1e-3
        for _ in range(_ROUNDS):
            step = _STEP * np.maximum(np.abs(theta), 1e-6)
            J = np.column_stack([(residual(theta + h) - r) / h.sum() for h in np.diag(step)])
            if not np.all(np.isfinite(J)) or np.abs(r).max() < 0.1 * EQUIVALENT:
                break
            scale = np.sqrt((J**2).sum(axis=0)) + 1e-300
            A = np.vstack([J / scale, np.sqrt(damping) * np.eye(len(theta))])
            move = np.linalg.lstsq(A, -np.append(r, np.zeros(len(theta))), rcond=None)[0] / scale
            tried = residual(theta + move)
            with np.errstate(over="ignore"):  # too long a step
                better = bool(np.all(np.isfinite(tried)) and tried @ tried < r @ r)
            if better:
                theta, r, damping = theta + move, tried, max(damping / 5.0, 1e-12)
            elif (damping := 5.0 * damping) > 1e8:
                break
        return bool(np.abs(r).max() <= EQUIVALENT)
