"""Running a plan: one session, from a checked plan to the last missing reading.

Nothing moves without a checked plan, and any failure stops the arm before anything else.
"""

import shlex
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any

from hilcal.cell import Cell
from hilcal.errors import DeviceError, HilcalError, InputError
from hilcal.measuring.connect import Rig, Setup
from hilcal.measuring.devices import ArmDevice, Clock
from hilcal.measuring.progress import Phase, Remark, Watcher
from hilcal.measuring.route import dry_run, route
from hilcal.measuring.session import LiveModel, Session, StoppingRule
from hilcal.store.plan import UNLOADED, Plan, Step
from hilcal.store.run_log import RunLog

HOW_ON = "The campaign is safe: run again with --resume"
EMERGENCY = "press the emergency stop"
_STOPS = 3  # attempts to stop the arm
_LATER = (Exception, KeyboardInterrupt)
"""What may follow the error that ends a session, and must not hide it: it tells of a moving arm."""


def run(
    rig: Rig,
    cell: Cell,
    plan: Plan,
    store: RunLog,
    clock: Clock,
    watcher: Watcher,
    live: LiveModel | None = None,
    wall: Callable[[], float] = time.time,
    goal: StoppingRule | None = None,
    epoch: float | None = None,
    stop_requested: Callable[[], bool] = lambda: False,
) -> None:
    """Measure the missing steps of a plan, until the goal is met.

    Every reading is stored before the next motion. After any exception, a keyboard interrupt
    included, the arm is stopped before anything else. The rig stays open. Steps that were measured
    are not checked again: limits may have been narrowed since. `live` compares each reading
    with a model. Once the `goal` is met, the arm moves home, the load is taken off, and the
    other steps are not measured. `wall` is the time of day, s, which continues the campaign's time
    after a pause; it counts from `epoch`, by default the start of the first session.
    `stop_requested` is asked with every sample of the arm; a stop then is a keyboard interrupt.

    Raises:
        InputError: the plan is not safe (names the first problem), or the store fails.
        DeviceError: a device failed, a limit was exceeded, a person gave up.
        KeyboardInterrupt: unchanged; the arm stands.
    """
    done = store.done()
    missing = plan.without(done)
    if not missing.steps:
        watcher.notify(Phase("nothing is missing"))
        return
    _refuse_unsafe(cell, missing)
    for text in dry_run(cell, plan).remarks:
        watcher.notify(Remark(text))
    setup = Setup(rig, cell, clock, watcher, stop_requested)
    session = Session(setup, plan, store, live, wall, goal, epoch)
    try:
        session.visit(route(missing, cell.arm, cell.configured().limits.joint_margin_rad))
    except BaseException as error:
        trouble = _stop(rig.arm) if session.in_control else ""
        with suppress(*_LATER):
            session.remark_on_payload()
        failed_before = session.pose is not None and _failed_at(store) == session.pose
        _note(store, error, trouble, session.pose)
        lost = ", and without watching drift" if session.pose == plan.home else ""
        advice = f"goes on without readings there{lost}"
        _raise(error, trouble, session.pose if failed_before else None, advice)


def _refuse_unsafe(cell: Cell, missing: Plan) -> None:
    """Refuse a plan with problems: InputError names the first, and how many more there are."""
    checked = dry_run(cell, missing)
    if not checked.problems:
        return
    home, advice = missing.home, "; --skip POSE leaves a pose out"
    if dry_run(cell, replace(missing, steps=(Step(home, UNLOADED),))).problems:
        advice = (
            f"; every session goes to {home}, which --skip cannot leave out: put back the cell "
            "with which the campaign was begun, or begin another campaign"
        )
    raise InputError(
        f"the plan is not safe to run, nothing has moved: {checked.first_problem}{advice}"
    )


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


def _failed_at(store: RunLog) -> str | None:
    """Return the pose at which the last session that failed did so; None where unknown."""
    with suppress(*_LATER):
        return (store.last("failed") or {}).get("pose")
    return None


def _note(store: RunLog, error: BaseException, trouble: str, pose: str | None) -> None:
    """Store why the session ended, and at which pose, if possible."""
    content: dict[str, Any] = {"wall_s": time.time(), "reason": _line(error), "pose": pose}
    if trouble:
        content["arm_not_stopped"] = trouble
    if not isinstance(error, HilcalError | KeyboardInterrupt):
        content["trace"] = "".join(traceback.format_exception(error))
    kind = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
    with suppress(*_LATER):
        store.event(kind, content)


def _raise(error: BaseException, trouble: str, failed_before: str | None, skipped: str) -> None:
    """Raise the error with advice; a previous session failed at the pose `failed_before`, too.

    `skipped` says what happens without that pose.
    """
    if not isinstance(error, Exception) and not trouble:
        raise error
    sentences = [_line(error)]
    if not isinstance(error, HilcalError | KeyboardInterrupt):
        sentences = [f"unexpected {sentences[0]} (its details are in the campaign)"]
    if trouble and EMERGENCY not in sentences[0]:
        sentences.append(f"THE ARM MAY STILL MOVE ({trouble}): {EMERGENCY}")
    elif failed_before is not None and isinstance(error, Exception):
        skip = shlex.join(["--skip", failed_before])
        sentences.append(f"It failed at {failed_before} before, too: {skip} {skipped}")
    ended = [x if x.endswith(("?", "!")) else f"{x}." for x in sentences]
    kind = type(error) if isinstance(error, HilcalError) and not trouble else DeviceError
    raise kind(" ".join([*ended, HOW_ON])) from error


def _line(error: BaseException) -> str:
    if isinstance(error, KeyboardInterrupt):
        return "interrupted"
    text = " ".join(str(error).split()).rstrip(".;")
    return text if isinstance(error, HilcalError) else f"{type(error).__name__}: {text}"
