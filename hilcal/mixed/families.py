"""Families: the parameters of a model that share one standard deviation.

What arms are like before anything is measured: log standard deviations, normal and correlated.

    log s_f = mean_f + a + b_effect(f) + c_f
    a ~ N(0, ARM²),  b ~ N(0, EFFECT²),  c_f ~ N(0, spread_f²)

A family may be divided into lines k, each of a size of its own: log s_k = log s_f + d_k,
d_k ~ N(0, LINE²).

An arm is precise or not in most of its parts (a), and the families of one effect, as the octaves of
a gear's error, are large or small together (b). With few poses this keeps one octave from taking
what others explain; independent priors of the same spread predicted 4 % worse with 20 poses of the
real UR10 and of a real UR5. Components of the noise have their own spread alone.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from hilcal.effects.protocol import FRAME_ROLES, Effect
from hilcal.model.model import Model
from hilcal.types import Floats, Ints

KNOWN = 1e-3  # spread of the logarithm of a standard deviation that is known
ARM = 1.5
"""Of an arm as a whole: a factor of 4.5 either way, so that one whose errors are a tenth or ten
times the ordinary ones is no surprise; a choice."""
EFFECT = 1.0  # of an effect beside its arm: a factor of 2.7; a choice
LINE = 0.7
"""Of a line of an effect, as one wave of one gear, beside its pool: a factor of 2; a choice. With
0.5 to 1 simulated transmission errors were predicted alike."""


@dataclass(frozen=True, slots=True)
class LogStdPrior:
    """What is known of the logarithm of a standard deviation before it is estimated: normal."""

    mean: float  # of log s, s in ordinary magnitudes
    # standard deviation of what is its own; see `mixed.families` for what families share
    spread: float


@dataclass(frozen=True, slots=True, eq=False)
class Family:
    """Parameters u ~ N(0, s² D) of one effect."""

    name: str  # the effect's, with what sets the family apart where the effect has several
    effect: str
    parameters: Ints  # (q,) indices of the parameters in the model
    magnitude: Floats  # (q,) root of D's diagonal: ordinary magnitudes, SI
    prior: LogStdPrior  # what is known of log s
    known: bool = False  # whether s is known, and shares nothing with other families
    pool: str = ""  # what families of one effect belong to that are lines of it; empty for others
    pool_spread: float = 0.0  # of what the log s of the families of a pool share


@dataclass(frozen=True, slots=True, eq=False)
class Families:
    """All parameters of a model."""

    frames: Ints  # (F,) indices of those without a prior: registration and target, flat effects
    random: tuple[Family, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the families."""
        return tuple(f.name for f in self.random)


def families_of(model: Model, flat: Collection[str] = (), lines: Collection[str] = ()) -> Families:
    """Return the families of a model.

    Parameters of one effect with the same unit make a family, in an effect with pools (as the
    octaves of harmonics) each pool one. A frame with a prior (`Effect.prior_std`), as deflections
    need, is a family of known standard deviation.

    Args:
        flat: effects of it whose parameters have no prior.
        lines: effects of which each group is a family, about the size of its pool.
    """
    frames: list[Ints] = []
    random: list[Family] = []
    for effect, mine in zip(model.effects, model.slices(), strict=True):
        index = np.arange(mine.start, mine.stop)
        std = effect.prior_std() if effect.role in FRAME_ROLES else None
        if std is not None:
            known = LogStdPrior(0.0, KNOWN)
            random.append(Family(effect.name, effect.name, index, std, known, known=True))
        elif effect.role in FRAME_ROLES or effect.name in flat:
            frames.append(index)
        else:
            random += _lines(effect, index) if effect.name in lines else _of_effect(effect, index)
    return Families(np.concatenate([np.zeros(0, dtype=np.int64), *frames]), tuple(random))


def expected_sizes(effect: Effect) -> tuple[tuple[str, float, str], ...]:
    """Return what is expected of the families of an effect: name, standard deviation (SI), unit."""
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
        own = np.array([k == key for k in keys])
        unit, pool = key
        parts = [unit] * several_units + [str(pool)] * several_pools
        name = f"{effect.name}[{', '.join(parts)}]" if parts else effect.name
        prior = effect.expected_log_std(pool)
        out.append(
            Family(name, effect.name, index[own], effect.magnitudes[own], LogStdPrior(*prior))
        )
    return out


def _lines(effect: Effect, index: Ints) -> list[Family]:
    groups, out = effect.groups(), []
    for pool in _of_effect(effect, index):
        own = np.isin(index, pool.parameters)
        group = np.zeros(len(index), dtype=np.int64) if groups is None else groups
        for k in np.unique(group[own]):
            mine = own & (group == k)
            prior = LogStdPrior(pool.prior.mean, LINE)
            name = f"{pool.name}, line {k}"
            out.append(
                Family(
                    name, effect.name, index[mine], effect.magnitudes[mine], prior,
                    pool=pool.name, pool_spread=pool.prior.spread,
                )
            )  # fmt: skip
    return out


def log_std_prior(
    priors: Sequence[LogStdPrior], families: Sequence[Family]
) -> tuple[Floats, Floats]:
    """Mean (F + N,) and precision (F + N, F + N) of log s of families and of η."""
    covariance = np.diag([p.spread**2 for p in priors])
    effect = np.array([f.effect for f in families])
    unknown = np.array([not f.known for f in families], dtype=float)
    shared = (ARM**2 + EFFECT**2 * (effect[:, None] == effect)) * np.outer(unknown, unknown)
    pool, spread = np.array([f.pool for f in families]), [f.pool_spread for f in families]
    shared += (pool[:, None] == pool) * np.outer(spread, spread)
    covariance[: len(effect), : len(effect)] += shared
    return np.array([p.mean for p in priors]), np.linalg.inv(covariance)
