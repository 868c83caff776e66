"""Running a campaign: nothing moves without a checked plan, and whatever fails stops the arm."""

import time
import traceback
from collections.abc import Callable
from typing import Any

from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.errors import DeviceError, HilcalError, InputError
from hilcal.measuring.connect import Rig
from hilcal.measuring.devices import ArmDevice, Clock
from hilcal.measuring.progress import Phase, Remark, Watcher
from hilcal.measuring.route import DryRun, dry_run, route
from hilcal.measuring.session import LiveModel, Session, StoppingRule
from hilcal.store.plan import Plan
from hilcal.store.run_log import RunLog

HOW_ON = "The campaign is safe: run again with --resume"
EMERGENCY = "press the emergency stop"
_STOPS = 3


def run(
    rig: Rig,
    cell: Cell,
    config: CellConfig,
    plan: Plan,
    store: RunLog,
    clock: Clock,
    watcher: Watcher,
    live: LiveModel | None = None,
    wall: Callable[[], float] = time.time,
    goal: StoppingRule | None = None,
    epoch: float | None = None,
) -> None:
    """Measure what is missing of a plan, or as much of it as a goal needs.

    Every reading is stored before the next motion. Whatever is raised, also an interrupt from the
    keyboard, the arm is stopped before anything else is done. The rig stays open. `live` compares
    each reading with a model. As soon as the `goal` is met the arm goes home, the load is taken
    off, and the rest is not measured. `wall` is the time of day, s, which carries the campaign's
    time over a pause; it counts from `epoch`, the first session's beginning unless given.

    Raises:
        InputError: the plan is not safe (names the first problem), or the store fails.
        DeviceError: a device failed, a limit was exceeded, a person gave up.
        KeyboardInterrupt: as it came; the arm stands.
    """
    whole = dry_run(cell, config, plan)
    refuse(whole)
    left = plan.without(store.done())
    if not left.steps:
        watcher.notify(Phase("nothing is missing"))
        return
    refuse(dry_run(cell, config, left))  # the way past what is done is another one
    for text in whole.remarks:
        watcher.notify(Remark(text))
    stops = route(left, cell.arm, config.limits.joint_margin_rad)
    session = Session(rig, cell, config, plan, store, clock, watcher, live, wall, goal, epoch)
    try:
        session.walk(stops)
    except BaseException as error:
        trouble = _stop(rig.arm) if session.in_control else ""
        _note(store, error, trouble)
        _raise(error, trouble)


def refuse(checked: DryRun) -> None:
    """Refuse a plan with problems: InputError names the first, and how many more there are."""
    if checked.problems:
        raise InputError(f"the plan is not safe to run, nothing has moved: {checked.first}")


def _stop(arm: ArmDevice) -> str:
    """Stop the arm; returns why it may not stand, empty where it does."""
    for _ in range(_STOPS):
        try:
            arm.stop()
        except KeyboardInterrupt:  # impatience must not keep the arm from stopping
            continue
        except Exception as error:  # whatever it is, people have to know
            return _line(error)
        return ""
    return "interrupted"


def _note(store: RunLog, error: BaseException, trouble: str) -> None:
    """Store why the session ended, as far as that is possible."""
    content: dict[str, Any] = {"wall_s": time.time(), "reason": _line(error)}
    if trouble:
        content["arm_not_stopped"] = trouble
    if not isinstance(error, HilcalError | KeyboardInterrupt):
        content["trace"] = "".join(traceback.format_exception(error))
    kind = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
    try:
        store.event(kind, content)
    except Exception:  # the error that is raised is the one that came first
        return


def _raise(error: BaseException, trouble: str) -> None:
    if not isinstance(error, Exception) and not trouble:
        raise error
    text = _line(error)
    if not isinstance(error, HilcalError | KeyboardInterrupt):
        text = f"unexpected {text} (its details are in the campaign)"
    if trouble and EMERGENCY not in text:
        text = f"{_sentence(text)}THE ARM MAY STILL MOVE ({trouble}): {EMERGENCY}"
    kind = type(error) if isinstance(error, HilcalError) and not trouble else DeviceError
    raise kind(_sentence(text) + HOW_ON) from error


def _sentence(text: str) -> str:
    """Return a text with what ends a sentence, for another to follow."""
    return f"{text} " if text.endswith(("?", "!")) else f"{text}. "


def _line(error: BaseException) -> str:
    if isinstance(error, KeyboardInterrupt):
        return "interrupted"
    words = " ".join(str(error).split()).rstrip(".;")
    return words if isinstance(error, HilcalError) else f"{type(error).__name__}: {words}"
