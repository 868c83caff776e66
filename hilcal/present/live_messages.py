"""What a command tells the process of its live viewer, besides the events of `progress`."""

from dataclasses import dataclass

from hilcal.present.story import Story
from hilcal.robot.arm import Arm
from hilcal.store.plan import Plan, Step
from hilcal.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Measuring:
    """A campaign begins, or goes on, to be measured.

    Attributes:
        name: of the campaign.
        arm: the arm.
        targets: (T, 3) tracked targets, flange axes, m.
        plan: the whole plan.
        earlier: what earlier sessions stored, each with its time of day, s.
        names: of the targets, where there are several.
    """

    name: str
    arm: Arm
    targets: Floats
    plan: Plan
    earlier: tuple[tuple[float, Step], ...] = ()
    names: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Revised:
    """A revision has been fitted and judged.

    Attributes:
        story: the readings, and this revision alone.
    """

    story: Story
