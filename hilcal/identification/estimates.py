"""The parameters of a fit as a table: name, value, standard uncertainty, unit, identifiable.

`summary` is the fit as plain text, for an interactive session.
"""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, overload

import numpy as np

from hilcal.errors import InputError
from hilcal.identification.residual import ErrorBlock
from hilcal.optional import needed_by
from hilcal.toml import suggest
from hilcal.types import Bools, Floats

if TYPE_CHECKING:
    import pandas as pd

    from hilcal.model.model import Model


@dataclass(frozen=True, slots=True)
class Estimate:
    """One fitted parameter.

    Attributes:
        name: effect and parameter, e.g. "joint_compliance.j2".
        value: estimate, SI; None where the data do not determine it.
        std: standard uncertainty, SI; None where the data do not determine it.
        unit: SI unit.
        identifiable: whether the data determine it.
    """

    name: str
    value: float | None
    std: float | None
    unit: str
    identifiable: bool

    def line(self, width: int = 0) -> str:
        """Return it in a line, the name padded to a width."""
        value = "not determined"
        if self.value is not None and self.std is not None:
            value = f"{self.value: .4e} ± {self.std:.1e} {self.unit}"
        return f"  {self.name:<{width}}  {value}"


@dataclass(frozen=True, slots=True)
class Estimates(Sequence[Estimate]):
    """The fitted parameters, in the order of the model; those of dropped groups are left out.

    Attributes:
        rows: one per parameter.
    """

    rows: tuple[Estimate, ...]

    @classmethod
    def of(
        cls, model: "Model", theta: Floats, std: Floats, identifiable: Bools, kept: Bools
    ) -> "Estimates":
        """Return the parameters (P,) of a model that are `kept`.

        A standard uncertainty (P,) that is infinite stands for none.
        """
        names = [(f"{e.name}.{p.name}", p.unit) for e in model.effects for p in e.parameters]
        seen = identifiable & np.isfinite(std)
        return cls(
            tuple(
                Estimate(
                    name,
                    float(theta[k]) if identifiable[k] else None,
                    float(std[k]) if seen[k] else None,
                    unit,
                    bool(identifiable[k]),
                )
                for k, (name, unit) in enumerate(names)
                if kept[k]
            )
        )

    def __repr__(self) -> str:
        """Return the first parameters, a line each."""
        width = max((len(row.name) for row in self.rows), default=0)
        lines = [row.line(width) for row in self.rows[:12]]
        left = len(self.rows) - len(lines)
        return "\n".join(["Estimates(", *lines, *([f"  ... and {left} more"] * bool(left)), ")"])

    def __len__(self) -> int:
        """Return the number of parameters."""
        return len(self.rows)

    def __iter__(self) -> Iterator[Estimate]:
        """Yield the parameters in order."""
        return iter(self.rows)

    @overload
    def __getitem__(self, key: int | str) -> Estimate: ...
    @overload
    def __getitem__(self, key: slice) -> Sequence[Estimate]: ...
    def __getitem__(self, key: int | str | slice) -> Estimate | Sequence[Estimate]:
        """Return a parameter by place or by name.

        Raises:
            InputError: no parameter has that name.
        """
        if isinstance(key, int | slice):
            return self.rows[key]
        for row in self.rows:
            if row.name == key:
                return row
        names = tuple(row.name for row in self.rows)
        raise InputError(f"no parameter {key!r}{suggest(key, names)}; valid: {', '.join(names)}")

    def to_dicts(self) -> list[dict[str, object]]:
        """Return one dictionary per parameter, as JSON documents hold them."""
        return [asdict(row) for row in self.rows]

    def to_frame(self) -> "pd.DataFrame":
        """Return a pandas data frame, indexed by the names.

        Raises:
            InputError: pandas is not installed.
        """
        with needed_by("to_frame (to_dicts returns the same without pandas)"):
            import pandas as pd
        return pd.DataFrame(self.to_dicts()).set_index("name")


def summary(
    names: tuple[str, ...],
    fitted: str,
    estimates: Estimates,
    errors: tuple[ErrorBlock, ErrorBlock],
    variance_factor: float,
    interval: tuple[float, float],
) -> str:
    """Return the model, its errors and its parameters, a line each.

    Args:
        names: of the model's effects.
        fitted: number and kind of the measurements, and their scaling.
        estimates: the parameters.
        errors: of the fit, and on poses left out.
        variance_factor: χ²/dof.
        interval: its 95 % confidence interval.
    """
    lines = [f"{' + '.join(names) or 'nominal arm'}, fitted to {fitted}"]
    for what, e in zip(("fitted poses", "poses left out"), errors, strict=True):
        lines.append(
            f"  error on {what}: {1e6 * e.rms_m:.1f} µm rms, {1e6 * e.max_m:.1f} µm largest, "
            f"{e.rms_sigma:.2f} σ"
        )
    lines.append(f"  variance factor {variance_factor:.3g} [{interval[0]:.3g}, {interval[1]:.3g}]")
    width = max((len(row.name) for row in estimates), default=0)
    return "\n".join([*lines, *(row.line(width) for row in estimates)])
