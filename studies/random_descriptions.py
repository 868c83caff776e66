"""Random arms, registrations and errors of description, for the check after registration.

Each case draws an arm (DH rows, signs, couplings, with or without masses, or one of the catalogue),
poses of one kind, frames, noise, geometric errors of an uncalibrated arm, and in half of the cases
one error of description. Readings are computed with the true arm.
"""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.cell import STANDARD_GRAVITY, Cell
from hilcal.errors import CannotAnswerError
from hilcal.identification.registration.hypotheses import Description, Hypothesis
from hilcal.identification.registration.misdescription import DescriptionFinding, examine
from hilcal.identification.registration.registration import register
from hilcal.readings.readings import Readings, States
from hilcal.robot import se3
from hilcal.robot.arm import Arm, possible_couplings, with_conventions
from hilcal.robot.catalogue import load_arm, robot_names
from hilcal.robot.chain import evaluate, joint_jacobian
from hilcal.types import Floats

ARMS = tuple(name for name in robot_names() if name.startswith("ur"))
POSES = ("general", "one orientation", "plane", "one axis", "small region")
ERRORS = (
    "sign",
    "quarter",
    "zero",
    "coupling",
    "degrees",
    "attitude degrees",
    "millimetres",
    "mirrored",
    "inverse",
    "swapped rows",
    "other arm",
    "two signs",
)


@dataclass(frozen=True, slots=True, eq=False)
class DescriptionCase:
    """One draw.

    Attributes:
        cell: as described.
        readings: as given to the program.
        truth: differences from the description; empty without any, or where rows are swapped.
        error: kind of the error, or None.
        poses: kind of the poses.
        best: misfit with the true description, m; attitudes count with a lever.
        hidden: whether the frames hide the error in these poses.
    """

    cell: Cell
    readings: Readings
    truth: tuple[Hypothesis, ...]
    error: str | None
    poses: str
    best: float
    hidden: bool


def random_arm(rng: np.random.Generator) -> Arm:
    """Return an arm of six joints with rows as of industrial arms."""
    turns = rng.choice([0.0, np.pi / 2, -np.pi / 2], 6, p=[0.3, 0.35, 0.35])
    turns[[0, 4]] = rng.choice([np.pi / 2, -np.pi / 2], 2)  # no two parallel axes in a wrist
    turns[3] = rng.choice([np.pi / 2, -np.pi / 2])
    links = [np.eye(4)]
    for turn in turns:
        link = np.eye(4)
        link[:3, :3] = se3.rotation(np.array([turn, 0.0, 0.0]))
        link[:3, 3] = [rng.uniform(0.0, 0.6), 0.0, rng.uniform(-0.3, 0.4)]
        links.append(link)
    mass = rng.random() < 0.5
    arm = Arm(
        name="drawn",
        links=np.array(links),
        masses=rng.uniform(1, 9, 6) * mass,
        coms=rng.normal(0, 0.1, (6, 3)),
        q_min=np.full(6, -2 * np.pi),
        q_max=np.full(6, 2 * np.pi),
        torque_max=np.full(6, 200.0),
        payload=10.0,
        joint_names=tuple(f"j{k}" for k in range(1, 7)),
        source="drawn",
    )
    if rng.random() < 0.3:
        return load_arm(str(rng.choice(ARMS)))
    sign, zero, coupled = rng.choice([-1.0, 1.0], 6), np.zeros(6), np.zeros((6, 6))
    if rng.random() < 0.3:
        joint, follows = possible_couplings(6)[rng.integers(6)]
        coupled[joint - 1, follows - 1] = rng.choice([-1.0, 1.0])
    return with_conventions(arm, sign, zero, coupled)


def random_error(kind: str, arm: Arm, rng: np.random.Generator) -> tuple[Hypothesis, ...]:
    """Return the differences of the true arm or readings from the description."""
    j = int(rng.integers(1, 7))
    if kind == "sign":
        return (Hypothesis("joint", j, -1),)
    if kind == "two signs":
        i, k = sorted(rng.choice(6, 2, replace=False) + 1)
        return Hypothesis("joint", int(i), -1), Hypothesis("joint", int(k), -1)
    if kind == "quarter":
        return (Hypothesis("joint", j, 1, float(rng.choice([1, -1, 2])) * np.pi / 2),)
    if kind == "zero":
        return (
            Hypothesis("joint", j, 1, float(np.radians(rng.uniform(3, 170)) * rng.choice([-1, 1]))),
        )
    if kind == "coupling":
        joint, follows = possible_couplings(6)[int(rng.integers(1, 6))]
        factor = float(rng.choice([-1.0, 1.0]))
        return (Hypothesis("coupling", joint, follows=follows, factor=factor),)
    if kind == "other arm":
        names = [n for n in ARMS if n != arm.name]
        return (Hypothesis("arm", arm=str(rng.choice(names))),)
    simple = {
        "degrees": Hypothesis("joint_degrees"),
        "attitude degrees": Hypothesis("turn_degrees"),
        "millimetres": Hypothesis("millimetres"),
        "mirrored": Hypothesis("mirrored"),
        "inverse": Hypothesis("inverse"),
    }
    return (simple[kind],) if kind in simple else ()


def random_poses(kind: str, arm: Arm, count: int, rng: np.random.Generator) -> Floats:
    """Return joint values (N, 6) of one kind of poses."""
    middle = rng.uniform(-1.5, 1.5, 6)
    if kind == "one axis":
        q = np.tile(middle, (count, 1))
        q[:, rng.integers(6)] += np.linspace(-0.8, 0.8, count)
        return q
    if kind == "small region":
        return middle + rng.uniform(-0.04, 0.04, (count, 6))
    if kind == "general":
        return rng.uniform(-2, 2, (count, 6))
    q = middle + rng.uniform(-0.5, 0.5, (count, 6))
    first = evaluate(arm, middle[None])
    base, turn = first.position[-1][0], first.rotation[-1][0]
    for _ in range(30):  # Newton, damped, towards one orientation or into one plane
        chain = evaluate(arm, q)
        jac = joint_jacobian(chain, chain.position[-1])
        if arm.coupling is not None:
            jac = jac @ arm.coupling
        if kind == "plane":
            off, rows = (chain.position[-1] - base)[:, 2:3], jac[:, 2:3]
        else:
            back = turn @ np.swapaxes(chain.rotation[-1], 1, 2)
            off, rows = -se3.rotation_vector(back), jac[:, 3:]
        square = rows @ np.swapaxes(rows, 1, 2) + 1e-6 * np.eye(rows.shape[1])
        step = np.swapaxes(rows, 1, 2) @ np.linalg.solve(square, off[..., None])
        q = q - np.clip(step[..., 0], -0.3, 0.3)
    return np.asarray(q[np.abs(off).max(axis=1) < 1e-6])


def draw(rng: np.random.Generator) -> DescriptionCase:
    """Draw a case, anew where the poses do not allow a registration."""
    while True:
        case = _draw(rng)
        if case is not None:
            return case


def _draw(rng: np.random.Generator) -> DescriptionCase | None:
    m = int(rng.choice([3, 6]))
    kind = str(rng.choice(POSES))
    error = str(rng.choice(ERRORS)) if rng.random() < 0.5 else None
    if m == 3 and error in ("attitude degrees", "inverse"):
        error = "sign"
    arm = random_arm(rng)
    if error == "other arm":
        arm = load_arm(str(rng.choice(ARMS)))
    truth = random_error(error, arm, rng) if error else ()
    true_arm = arm
    for change in truth:
        if change.kind in ("joint", "coupling", "arm"):
            nothing = np.zeros((1, 6))
            described = Description(true_arm, nothing, nothing[:, :3], None, True, True)
            true_arm = change.applied(described).arm
    q = random_poses(kind, true_arm, int(rng.integers(25, 90)), rng)
    if len(q) < 12:
        return None
    cell = _cell(arm, rng)
    noise = 10 ** rng.uniform(-5, -3.7)
    sigma = np.repeat([noise, 2 * noise], 3)[:m]
    geometry = rng.choice([0.0, 2e-4])
    errors = [se3.matrix(*se3.exp(t)) for t in geometry * rng.normal(size=(7, 6))]
    bent = replace(true_arm, links=true_arm.links @ np.array(errors))
    base, target = _pose(rng, 3.0), _pose(rng, 0.2)
    if cell.registration_known:
        base = cell.registration
    if cell.target_known:
        target[:3, 3] = cell.target[:3, 3]
        if cell.registration_known:  # then the target's axes are not estimated either
            target = cell.target
    value = read(bent, q, base, target, m)
    error_m = rng.normal(size=value.shape) * sigma
    value[:, :3] += error_m[:, :3]
    if m == 6:
        turned = se3.rotation(error_m[:, 3:]) @ se3.rotation(value[:, 3:])
        value[:, 3:] = se3.rotation_vector(turned)
    clean = readings_of(q, value, sigma)
    wrong = _misdescribed(clean, error, rng)
    true_cell = replace(cell, arm=true_arm)
    try:
        best = _size(true_cell, clean)
        size = _size(cell, wrong)
    except CannotAnswerError:
        return None
    return DescriptionCase(cell, wrong, truth, error, kind, best, size < 3.0 * best + 1e-6)


def _cell(arm: Arm, rng: np.random.Generator) -> Cell:
    target = np.eye(4)
    target[:3, 3] = rng.uniform(-0.2, 0.2, 3)
    known, base_known = bool(rng.random() < 0.5), bool(rng.random() < 0.15)
    return Cell(
        arm=arm,
        target=target if known else np.eye(4),
        load_point=np.zeros(3),
        tool_mass=0.0,
        tool_com=np.zeros(3),
        gravity=STANDARD_GRAVITY,
        registration=_pose(rng, 3.0) if base_known else np.eye(4),
        registration_known=base_known,
        target_known=known,
    )


def _pose(rng: np.random.Generator, size: float) -> Floats:
    turn = rng.normal(size=3)
    turn *= rng.uniform(0, np.pi) / np.linalg.norm(turn)
    return se3.matrix(se3.rotation(turn), rng.uniform(-size, size, 3))


def read(arm: Arm, q: Floats, base: Floats, target: Floats, m: int) -> Floats:
    """Return noiseless readings (N, m) of an arm, by products of homogeneous matrices."""
    theta = arm.chain_angles(q)
    pose = np.broadcast_to(base @ arm.links[0], (len(q), 4, 4))
    for k in range(6):
        turn = np.tile(np.eye(4), (len(q), 1, 1))
        turn[:, 0, 0] = turn[:, 1, 1] = np.cos(theta[:, k])
        turn[:, 1, 0] = np.sin(theta[:, k])
        turn[:, 0, 1] = -turn[:, 1, 0]
        pose = pose @ turn @ arm.links[k + 1]
    pose = pose @ target
    turn_vector = se3.rotation_vector(np.ascontiguousarray(pose[:, :3, :3]))
    return np.hstack([pose[:, :3, 3], turn_vector])[:, :m]


def readings_of(q: Floats, value: Floats, sigma: Floats) -> Readings:
    """Readings (N, m) of joint values (N, 6) without loads, with standard deviations (m,)."""
    count = len(q)
    zero = np.zeros(count, dtype=np.int64)
    return Readings(
        states=States(q, np.zeros((count, 6))),
        pose=np.arange(count),
        load=zero,
        cycle=zero,
        value=value,
        covariance=np.tile(np.diag(sigma**2), (count, 1, 1)),
        load_names=("none",),
        pose_names=tuple(f"p{k + 1}" for k in range(count)),
    )


def _misdescribed(clean: Readings, error: str | None, rng: np.random.Generator) -> Readings:
    """Return the readings with an error of the table."""
    value, q = clean.value.copy(), clean.states.q
    mirror = np.array([1.0, -1.0, 1.0])
    if error == "degrees":
        q = np.degrees(q)
    elif error == "attitude degrees":
        value[:, 3:] = np.degrees(value[:, 3:])
    elif error == "millimetres":
        value[:, :3] *= 1e3
    elif error == "mirrored":
        value[:, :3] *= mirror
        value[:, 3:] *= -mirror[: value.shape[1] - 3]
    elif error == "inverse":
        turn = se3.rotation(value[:, 3:])
        value[:, :3] = -np.einsum("nji,nj->ni", turn, value[:, :3])
        value[:, 3:] *= -1.0
    elif error == "swapped rows":
        i, j = rng.choice(len(value), 2, replace=False)
        value[[i, j]] = value[[j, i]]
    return replace(clean, value=value, states=replace(clean.states, q=q))


def _size(cell: Cell, readings: Readings) -> float:
    registered = register(cell, readings)
    return float(np.hypot(registered.rms, 0.3 * (registered.turn_rms or 0.0)))


@dataclass(frozen=True, slots=True)
class DescriptionOutcome:
    """Answer of the program to a case.

    Attributes:
        right: whether it registered to the noise, or refused with a right reason.
        named: whether it named the error, or an equivalent one that fits as well with no more
            changes; None without an error, or where the frames hide it.
        exact: whether it named the true error among others.
    """

    right: bool
    named: bool | None
    exact: bool


def judge(case: DescriptionCase) -> tuple[DescriptionOutcome, DescriptionFinding | None]:
    """Run the program on a case."""
    finding = examine(register(case.cell, case.readings), case.readings)
    refused = finding is not None and finding.refused
    if case.error is None or case.hidden:
        return DescriptionOutcome(not refused, None, False), finding
    if case.error == "swapped rows":
        named = finding is not None and bool(finding.rows.any()) and not finding.explanations
        return DescriptionOutcome(named, named, named), finding
    explanations = [] if finding is None else list(finding.explanations)
    exact = any(_keys(e.changes) == _keys(case.truth) for e in explanations)
    fits = bool(explanations) and explanations[0].rms < 3.0 * case.best + 1e-6
    fewer = bool(explanations) and len(explanations[0].changes) <= len(case.truth)
    named = exact or (fits and fewer)
    return DescriptionOutcome(named or (refused and fits), named, exact), finding


def _keys(changes: tuple[Hypothesis, ...]) -> list[tuple[object, ...]]:
    return sorted((c.kind, c.joint, c.follows, c.sign, c.factor, c.arm) for c in changes)
