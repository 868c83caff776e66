"""`hysteresis`: friction and lost motion, by the side from which a joint arrived."""

from hilcal.effects.per_joint import PerJoint
from hilcal.effects.protocol import Changeable, Columns, Situation


class Hysteresis(PerJoint):
    """dq_j = h_j s_j with s_j = ±1 the side from which joint j arrived [rad]."""

    name = "hysteresis"
    unit, size, meaning = "rad", 2e-5, "half hysteresis of {joint}"
    summary = "dq_j = h_j s_j: the joint stops short on the side from which it arrived"
    change = Changeable("joint", words="lost motion", cause="wear or repair?", listed=True)
    plausible = 50.0  # 1 mrad; makers of gears state 0.3 mrad of lost motion. A choice.
    needs = ("approach",)

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Sides: ∂dq_j/∂h_j = s_j."""
        assert s.states.approach is not None  # noqa: S101 - checked at construction
        return (self.joint_columns("dq", s.states.approach),)
