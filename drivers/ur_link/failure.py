"""The message of a failure of the arm: which arm, what happened, what to do."""

from hilcal.errors import DeviceError

RESUME = "then run again with --resume"
CHECK_LINK = f"check the controller and the network cable, {RESUME}"
CONTROL = "control has to be taken first"
HOLD_ON = "NOT SURE THAT THE ARM STANDS: press the emergency stop if it moves"


def failure(host: str, cause: str, advice: str = "") -> DeviceError:
    """Return the error to raise, one line."""
    return DeviceError(f"arm at {host}: {cause}" + (f"; {advice}" if advice else ""))
