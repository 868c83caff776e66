"""Families: the parameters of a model that share one standard deviation.

The prior of the log standard deviations, before anything is measured, is normal and correlated:

    log s_f = mean_f + a + b_effect(f) + c_f
    a ~ N(0, ARM²),  b ~ N(0, EFFECT²),  c_f ~ N(0, spread_f²)

A family may be divided into lines k with log s_k = log s_f + d_k, d_k ~ N(0, LINE²).

Most parts of an arm are about equally precise (a), and the families of one effect, as the octaves
of a gear's error, are large or small together (b). With few poses this keeps one octave from
absorbing the errors of others: independent priors of the same spread predicted 4 % worse with
20 poses of the real UR10 and of a real UR5. Components of the noise share nothing.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hilcal.effects.protocol import FRAME_ROLES, Effect
from hilcal.model.model import Model
from hilcal.types import Floats, Ints

IMPLAUSIBLE_FACTOR = 2.0
"""Factor by which an estimated standard deviation may exceed the plausible one, as few readings
determine it to such a factor only; a choice."""
KNOWN_SPREAD = 1e-3  # spread of the logarithm of a standard deviation that is known
ARM_SPREAD = 1.5
"""Spread between arms: a factor of 4.5 either way, so that errors of a tenth or of ten times the
ordinary ones are plausible; a choice."""
EFFECT_SPREAD = 1.0  # spread between the effects of an arm: a factor of 2.7; a choice
LINE_SPREAD = 0.7
"""Spread between the lines of a pool, as the waves of one gear: a factor of 2; a choice. Any value
of 0.5 to 1 predicted simulated transmission errors equally well."""


@dataclass(frozen=True, slots=True)
class LogStdPrior:
    """Normal prior of the logarithm of a standard deviation."""

    mean: float  # of log s, s in ordinary magnitudes
    spread: float  # standard deviation without the terms a, b that families share


@dataclass(frozen=True, slots=True, eq=False)
class Family:
    """Parameters u ~ N(0, s² D) of one effect."""

    name: str  # of the effect, with unit and pool where the effect has several families
    effect: str
    parameters: Ints  # (q,) indices of the parameters in the model
    magnitude: Floats  # (q,) root of D's diagonal: ordinary magnitudes, SI
    prior: LogStdPrior  # of log s
    known: bool = False  # whether s is known; its log s is then independent of other families'
    pool: str = ""  # pool that the family is a line of; empty where it is none
    largest: float = np.inf  # s up to which a size is plausible, with `IMPLAUSIBLE_FACTOR`
    pool_spread: float = 0.0  # spread of the term that the log s of a pool's lines share


@dataclass(frozen=True, slots=True, eq=False)
class Families:
    """All parameters of a model."""

    frames: Ints  # (F,) indices of parameters without a prior: frames and flat effects
    random: tuple[Family, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the families."""
        return tuple(f.name for f in self.random)


def families_of(
    model: Model,
    flat: Collection[str] = (),
    lines: Collection[str] = (),
    known: Mapping[str, Floats] | None = None,
) -> Families:
    """Return the families of a model.

    The parameters of one effect with the same unit and in the same pool (as an octave of
    harmonics) are a family. A frame with a prior (`Effect.prior_std`), as deflections need, is a
    family of known standard deviation.

    Args:
        flat: effects whose parameters have no prior.
        lines: effects of which each group is a family, a line of its pool.
        known: standard deviations (q,) of the parameters of effects for which they are known.
    """
    frames: list[Ints] = []
    random: list[Family] = []
    for effect, columns in zip(model.effects, model.slices(), strict=True):
        index = np.arange(columns.start, columns.stop)
        std = (known or {}).get(effect.name)
        if effect.role in FRAME_ROLES:
            std = effect.prior_std()
        if std is not None:
            prior = LogStdPrior(0.0, KNOWN_SPREAD)
            random.append(Family(effect.name, effect.name, index, std, prior, known=True))
        elif effect.role in FRAME_ROLES or effect.name in flat:
            frames.append(index)
        else:
            random += _lines(effect, index) if effect.name in lines else _of_effect(effect, index)
    return Families(np.concatenate([np.zeros(0, dtype=np.int64), *frames]), tuple(random))


def expected_sizes(effect: Effect) -> tuple[tuple[str, float, str], ...]:
    """Return name, expected standard deviation (SI) and unit of each family of an effect."""
    if effect.role in FRAME_ROLES:
        return ()
    units, index = [p.unit for p in effect.parameters], np.arange(len(effect.parameters))
    return tuple(
        (f.name, float(np.exp(f.prior.mean) * np.median(f.magnitude)), units[f.parameters[0]])
        for f in _of_effect(effect, index)
    )


def _of_effect(effect: Effect, index: Ints) -> list[Family]:
    units = [p.unit for p in effect.parameters]
    pools = effect.pools()
    keys = list(zip(units, pools.tolist(), strict=True))
    several_units, several_pools = len(set(units)) > 1, len(set(pools.tolist())) > 1
    out = []
    for key in dict.fromkeys(keys):
        in_family = np.array([k == key for k in keys])
        unit, pool = key
        parts = [unit] * several_units + [str(pool)] * several_pools
        name = f"{effect.name}[{', '.join(parts)}]" if parts else effect.name
        prior = effect.expected_log_std(pool)
        out.append(
            Family(
                name, effect.name, index[in_family], effect.magnitudes[in_family],
                LogStdPrior(*prior), largest=IMPLAUSIBLE_FACTOR * effect.most(),
            )
        )  # fmt: skip
    return out


def _lines(effect: Effect, index: Ints) -> list[Family]:
    groups, out = effect.groups(), []
    for pool in _of_effect(effect, index):
        in_pool = np.isin(index, pool.parameters)
        group = np.zeros(len(index), dtype=np.int64) if groups is None else groups
        for k in np.unique(group[in_pool]):
            in_line = in_pool & (group == k)
            prior = LogStdPrior(pool.prior.mean, LINE_SPREAD)
            name = f"{pool.name}, line {k}"
            out.append(
                Family(
                    name, effect.name, index[in_line], effect.magnitudes[in_line], prior,
                    pool=pool.name, largest=pool.largest, pool_spread=pool.prior.spread,
                )
            )  # fmt: skip
    return out


def log_std_prior(
    priors: Sequence[LogStdPrior], families: Sequence[Family]
) -> tuple[Floats, Floats]:
    """Prior mean (F + N,) and precision (F + N, F + N) of log s and η."""
    covariance = np.diag([p.spread**2 for p in priors])
    effect = np.array([f.effect for f in families])
    unknown = np.array([not f.known for f in families], dtype=float)
    shared = (ARM_SPREAD**2 + EFFECT_SPREAD**2 * (effect[:, None] == effect)) * np.outer(
        unknown, unknown
    )
    pool, spread = np.array([f.pool for f in families]), [f.pool_spread for f in families]
    shared += (pool[:, None] == pool) * np.outer(spread, spread)
    covariance[: len(effect), : len(effect)] += shared
    return np.array([p.mean for p in priors]), np.linalg.inv(covariance)
