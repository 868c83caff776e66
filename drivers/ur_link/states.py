"""Meaning of the controller's codes for people, and advice to the operator.

Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide", controller output fields.
"""

from hilcal.errors import DeviceError

RESUME = "then run again with --resume"
CHECK_LINK = f"check the controller and the network cable, {RESUME}"
CONTROL = "control has to be taken first"
HOLD_ON = "NOT SURE THAT THE ARM STANDS: press the emergency stop if it moves"

ROBOT_MODES = {
    -1: "no controller",
    0: "disconnected",
    1: "safety to be confirmed",
    2: "booting",
    3: "power off",
    4: "power on",
    5: "idle (brakes on)",
    6: "backdrive",
    7: "running",
    8: "updating firmware",
}
RUNNING = 7

STOPPING, STOPPED, PLAYING, PAUSING, PAUSED, RESUMING = range(6)
RUNTIME_STATES = ("stopping", "stopped", "playing", "pausing", "paused", "resuming")

NORMAL = "normal"
REDUCED = 1  # bit of the reduced mode
# (bit of safety_status_bits, meaning, advice), the gravest first
_SAFETY = (
    (9, "safety fault", "restart the controller"),
    (8, "safety violation", "restart the safety system on the pendant"),
    (6, "emergency stop of the robot", "release the emergency stop and switch the robot on"),
    (5, "emergency stop of the system", "release the emergency stop and switch the robot on"),
    (7, "emergency stop", "release the emergency stop and switch the robot on"),
    (2, "protective stop", "find out what the arm touched, unlock it on the pendant"),
    (4, "safeguard stop", "leave the guarded area and reset the safeguard"),
    (3, "recovery mode", "move the joints inside their limits on the pendant"),
    (10, "stopped for safety", "look at the pendant"),
    (
        REDUCED,
        "reduced mode",
        "leave the zone that reduces the robot's limits; where it always works so: [robot.options] "
        "reduced_mode = true",
    ),
)


def safety_word(bits: int, mode: int = RUNNING) -> str:
    """Return the name of the safety state, or of a robot mode that keeps the arm from moving.

    "normal" if it can move.
    """
    ready = NORMAL if mode == RUNNING else f"not running ({mode_word(mode)})"
    return next((word for bit, word, _ in _SAFETY if bits >> bit & 1), ready)


def safety_advice(bits: int, mode: int = RUNNING) -> str:
    """Return advice about the safety state, or the mode; empty if normal."""
    ready = "" if mode == RUNNING else "switch it on and release the brakes"
    return next((advice for bit, _, advice in _SAFETY if bits >> bit & 1), ready)


def mode_word(mode: int) -> str:
    """Return the name of a robot mode."""
    return ROBOT_MODES.get(mode, f"robot mode {mode}")


def runtime_word(state: int) -> str:
    """Return the name of a state of the robot's program."""
    return RUNTIME_STATES[state] if 0 <= state < len(RUNTIME_STATES) else f"state {state}"


def version_word(version: tuple[int, ...]) -> str:
    """Return a controller version with dots."""
    return ".".join(map(str, version))


def failure(host: str, cause: str, advice: str = "") -> DeviceError:
    """Return the error of a failure of the arm: host, cause, advice."""
    return DeviceError(f"arm at {host}: {cause}" + (f"; {advice}" if advice else ""))
