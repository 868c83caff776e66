"""`template`: the compliance of a joint changes once per turn.

A file of effects, each a class derived from `Effect`. This one works as it stands; change its
name and its law. Every command that makes or reads models takes it:

    hilcal effects --effects-from template.py
    hilcal diagnose RUN.hilcal --effects-from template.py
    hilcal refine RUN.hilcal --effects-from template.py

Inside a package that is installed it is always there, by these lines of its pyproject.toml:

    [project.entry-points."hilcal.effects"]
    template = "your_package.template:Template"

All is in SI units: m, rad, N, N·m, s; temperatures in °C. N is the number of states, n that of
joints, P that of the effect's parameters. Slot k = 0..n is the frame after link k, from the base:
for k < n its z axis is the axis of joint k + 1; slot n is the flange.
"""

from typing import ClassVar

import numpy as np

from hilcal.effects.protocol import Columns, Effect, Parameter, Response, Situation
from hilcal.types import Floats


class Template(Effect):
    """dq_j = a_j sin(q_j) τ_j with q_j the angle and τ_j the static torque of joint j.

    As of a bearing that is softer on one side. A class whose name begins with "_" is ignored.
    """

    # What commands, files and reports call it: lower case, digits and _.
    name = "template"
    # The law in one line, for people.
    summary = "dq_j = a_j sin(q_j) τ_j: compliance that changes once per turn"
    # Whether the law depends on forces and torques; then `response` must be there, too. Leave
    # both out where it does not.
    elastic = True
    # Whether each slot deviates with the wrench through itself alone; Jacobians then cost less.
    local_response = True
    # Columns of the readings without which the law cannot be computed, of: time, load_time,
    # air_temperature, joint_temperature, approach, q_actual; e.g. ("time", "joint_temperature").
    # Where readings lack one of them, the effect is not among the suspects.
    needs = ()
    # How large the parameters are in practice: their standard deviation over arms and cells, in
    # ordinary magnitudes. A suspect that needs more is not named; leave it out if you do not know.
    plausible = 10.0
    # Options with their meaning; what is given for them is in self.options, e.g.
    # {"period": "angle of one turn of the bearing, rad; unless given, 2π."}.
    option_help: ClassVar[dict[str, str]] = {}

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """One amplitude per joint.

        The deviation must be linear in the parameters; put a number that is not (a period, a
        threshold) into the law. The scale is a magnitude that would be ordinary in practice: it
        decides what counts as determined by the readings, so its power of ten matters.
        """
        return tuple(
            Parameter(f"j{j + 1}", "rad/(N·m)", 3e-6, f"change of compliance of joint {j + 1}")
            for j in range(self.cell.arm.n)
        )

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Derivative of the deviation by the parameters: ∂dq_j/∂a_j = sin(q_j) τ_j.

        The law may use s.angle (N, n), s.torque (N, n), s.wrench (N, n + 1, 6: force and moment
        through each slot, in its axes), s.cell, and of the readings s.states.time (N,),
        s.states.joint_temperature (N, n) and so on; each state by itself. What depends on all
        states, as the first time does, belongs in `setup(self, states)`, which is called once.

        Columns(field, parameter, element, values) is what moves:

            "dq"       joint `element`, by values (N, P) in rad
            "twist"    everything beyond slot `element`, by values (N, P, 6): displacement and
                       rotation in the axes of the slot
            "base"     the base, by values (N, P, 6) in its axes
            "target"   the tracked target, by values (N, P, 6) in flange axes
            "station"  the readings about the tracker, by values (N, P, 6) in its axes
            "scale"    the tracker's distances, by values (N, P) relative to them

        with `parameter` (P,) the indices of the parameters; one that moves several joints is there
        several times. `element` (P,) is ignored where it is not named above. Several parts of
        a law are several Columns in the tuple.
        """
        joints = np.arange(self.cell.arm.n)
        return (Columns("dq", joints, joints, np.sin(s.angle) * s.torque),)

    def response(self, theta: Floats, s: Situation, change: Floats) -> Response:
        """Change of the deviation by changes of the wrenches: a_j sin(q_j) dτ_j.

        `theta` (P,) are the parameters, `change` (N, C, n + 1, 6) are C changes of s.wrench;
        that of the torques is s.along(change). Returns dq (N, C, n), twist (N, C, n + 1, 6)
        or both.
        """
        slope = theta * np.sin(s.angle)
        return Response(dq=slope[:, None, :] * s.along(change))
