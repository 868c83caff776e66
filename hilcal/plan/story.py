"""What a plan promises, as plain numbers: for the terminal, JSON and the viewer."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Promised:
    """Predicted standard uncertainty of a parameter.

    Attributes:
        name: e.g. "joint_compliance.j2".
        std: in `unit`, SI.
        value: known or ordinary magnitude, SI; None where there is none.
        unit: SI.
    """

    name: str
    std: float
    value: float | None
    unit: str


@dataclass(frozen=True, slots=True)
class Bought:
    """What a criterion buys for the same number of readings.

    The observability indices are those of Sun & Hollerbach (2008), of the whitened Jacobian by
    the parameters in ordinary magnitudes with the singular values σ.

    Attributes:
        criterion: its name.
        position_std_m: predicted standard uncertainty of the position at the test poses, m.
        position_open_m: the same where every effect that the plan is made against may be there.
        joint_share: largest standard uncertainty of a joint's parameter by its magnitude; None
            where no parameter belongs to a joint.
        o1: (Π σ)^(1/P) / √N, what D makes large; σ² the eigenvalues of the information on the
            model's parameters that have no prior, all others unknown as well.
        o2: σ_min / σ_max, what K makes large; of the model alone.
        o3: σ_min, what E makes large.
        efficiency: certified share of the best possible by its own criterion; None without.
    """

    criterion: str
    position_std_m: float | None
    position_open_m: float | None
    joint_share: float | None
    o1: float
    o2: float
    o3: float
    efficiency: float | None


@dataclass(frozen=True, slots=True)
class Enough:
    """A point of the curve of how many poses are enough.

    Attributes:
        poses: number of poses beside the reference.
        position_std_m: predicted standard uncertainty of the position at the test poses, m.
        efficiency: certified share of the best possible with so many; None without.
    """

    poses: int
    position_std_m: float
    efficiency: float | None = None


@dataclass(frozen=True, slots=True)
class Seen:
    """An effect outside of the model that the plan keeps power against.

    Attributes:
        effect: its name.
        least_m: rms displacement of the target at which it stands out by one sigma, m; None
            where these readings cannot tell it from the model.
    """

    effect: str
    least_m: float | None


@dataclass(frozen=True, slots=True)
class OrderStory:
    """What the order costs and saves; see `Confounding`.

    Attributes:
        longer: share of time beyond the shortest order.
        lost: largest share of its information that a parameter loses to a drift: of
            `information_lost` with the model's Jacobian, or ρ² of `Confounding` without.
        lost_shortest: the same in the shortest order.
        drift: stated drift, m/s.
        error_m: rms error of a deflection from that drift, m.
        bias_m: mean error, m.
        told: rate that the returns to the reference tell, one sigma, m/s; None where none.
    """

    longer: float
    lost: float
    lost_shortest: float
    drift: float
    error_m: float
    bias_m: float
    told: float | None


@dataclass(frozen=True, slots=True)
class PlanStory:
    """All that people are told of a plan.

    Attributes:
        poses: number of poses beside the reference.
        readings: of all, those at the reference included.
        loads: readings by load, "none" among them, in the order in which they are hung.
        load_changes: how often a person is asked for another load.
        motion_s: of the arm, s.
        readings_s: at rest, s.
        load_changes_s: by hand, s.
        criterion: name of the criterion.
        efficiency: certified share of the best possible; None without a certificate.
        predicted: by parameter.
        position_std_m: at the test poses, m; None without.
        bought: what each criterion buys; the plan's own among them.
        curve: how many poses are enough, fewest first.
        seen: effects outside of the model.
        order: what the order costs and saves.
        remarks: what people should know of it, one sentence each.
    """

    poses: int
    readings: int
    loads: dict[str, int]
    load_changes: int
    motion_s: float
    readings_s: float
    load_changes_s: float
    criterion: str
    efficiency: float | None
    predicted: tuple[Promised, ...]
    position_std_m: float | None
    bought: tuple[Bought, ...] = ()
    curve: tuple[Enough, ...] = ()
    seen: tuple[Seen, ...] = ()
    order: OrderStory | None = None
    remarks: tuple[str, ...] = ()
