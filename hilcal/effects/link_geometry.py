"""`link_geometry`: the links are not as long, straight and square as drawn."""

import numpy as np

from hilcal.effects.protocol import Changeable, Columns, Effect, Parameter, Situation

AXES = ("x", "y", "z", "rx", "ry", "rz")


class LinkGeometry(Effect):
    """Constant twist of each link, in the axes of its end; over-complete on purpose.

    Six parameters for each of the n + 1 links. Many combinations are not identifiable (a shift
    along a joint's axis can be made before or after it); rank analysis drops those.
    """

    name = "link_geometry"
    summary = "constant displacement and rotation of each link's end (over-complete)"
    kinematic = True
    change = Changeable("link", words="geometry", cause="crash?")
    plausible = 3.0  # 3 mm, 3 mrad; links differ from drawings by 0.1 to 2. A choice.

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Displacements [m] and rotations [rad] of links 0..n."""
        return tuple(
            Parameter(f"link{k}.{axis}", "m" if i < 3 else "rad", 1e-3)
            for k in range(self.cell.arm.n + 1)
            for i, axis in enumerate(AXES)
        )

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Unit twists of the slots."""
        slots = self.cell.arm.n + 1
        values = np.tile(np.eye(6), (slots, 1))[None]
        return (Columns("twist", np.arange(6 * slots), np.repeat(np.arange(slots), 6), values),)
