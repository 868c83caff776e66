"""The open devices of a cell."""

from dataclasses import dataclass

from hilcal.measuring.devices import ArmDevice, ForceSensorDevice, OperatorDevice, TrackerDevice


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """Every device that a campaign uses, connected.

    Attributes:
        arm: the arm.
        tracker: the tracker.
        force: the force sensor; None where the cell has none.
        operator: the person who hangs the loads.
    """

    arm: ArmDevice
    tracker: TrackerDevice
    force: ForceSensorDevice | None
    operator: OperatorDevice

    def close(self) -> None:
        """Close everything, the arm first. Never raises, may be called twice."""
        for device in (self.arm, self.tracker, self.force, self.operator):
            if device is not None:
                device.close()
