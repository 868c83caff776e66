"""Running a campaign: nothing moves without a checked plan, and any failure stops the arm."""

import time
import traceback
from collections.abc import Callable
from typing import Any

from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.errors import DeviceError, HilcalError, InputError
from hilcal.measuring.connect import Rig, Setup
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
    """Measure the missing steps of a plan, until the goal is met.

    Every reading is stored before the next motion. After any exception, a keyboard interrupt
    included, the arm is stopped before anything else. The rig stays open. `live` compares each
    reading with a model. Once the `goal` is met, the arm moves home, the load is taken off, and the
    other steps are not measured. `wall` is the time of day, s, which continues the campaign's time
    after a pause; it counts from `epoch`, by default the start of the first session.

    Raises:
        InputError: the plan is not safe (names the first problem), or the store fails.
        DeviceError: a device failed, a limit was exceeded, a person gave up.
        KeyboardInterrupt: unchanged; the arm stands.
    """
    full = dry_run(cell, config, plan)
    refuse(full)
    missing = plan.without(store.done())
    if not missing.steps:
        watcher.notify(Phase("nothing is missing"))
        return
    refuse(dry_run(cell, config, missing))  # its route differs
    for text in full.remarks:
        watcher.notify(Remark(text))
    stops = route(missing, cell.arm, config.limits.joint_margin_rad)
    setup = Setup(rig, cell, config, clock, watcher)
    session = Session(setup, plan, store, live, wall, goal, epoch)
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
    """Stop the arm; return why it may still move, or an empty text."""
    for _ in range(_STOPS):
        try:
            arm.stop()
        except KeyboardInterrupt:  # an interrupt must not prevent the stop
            continue
        except Exception as error:  # any error is reported
            return _line(error)
        return ""
    return "interrupted"


def _note(store: RunLog, error: BaseException, trouble: str) -> None:
    """Store why the session ended, if possible."""
    content: dict[str, Any] = {"wall_s": time.time(), "reason": _line(error)}
    if trouble:
        content["arm_not_stopped"] = trouble
    if not isinstance(error, HilcalError | KeyboardInterrupt):
        content["trace"] = "".join(traceback.format_exception(error))
    kind = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
    try:
        store.event(kind, content)
    except Exception:  # the first error is raised
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
    """Return a text that ends a sentence, with a space."""
    return f"{text} " if text.endswith(("?", "!")) else f"{text}. "


def _line(error: BaseException) -> str:
    if isinstance(error, KeyboardInterrupt):
        return "interrupted"
    text = " ".join(str(error).split()).rstrip(".;")
    return text if isinstance(error, HilcalError) else f"{type(error).__name__}: {text}"
