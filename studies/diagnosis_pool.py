"""Cases on several processes or a cluster: stoppable, and the same results every time."""

from collections.abc import Callable, Sequence

from hilcal.engine.engine import Advance, open_engine
from studies.diagnosis import Asked, Outcome

Run = Callable[[Asked], Outcome]


def run_all(
    questions: Sequence[Asked],
    run: Run,
    jobs: int | None,
    advance: Advance,
    scheduler: str | None = None,
) -> tuple[tuple[Outcome, ...], bool]:
    """Run all cases; those that are done, in order of the questions, and whether that is all.

    Ctrl-C ends it: cases that are running are let go, those that are done are returned.

    Args:
        questions: what to ask.
        run: runs a case; a function of a module, which other processes find by its name.
        jobs: processes; 1 runs all in this one, None on every processor.
        advance: told of each case that is done.
        scheduler: address of a cluster, in place of processes of this machine.
    """
    found: dict[int, Outcome] = {}
    try:
        with open_engine(jobs, scheduler) as engine:
            for number, outcome in engine.results(run, questions):
                found[number] = outcome
                advance(1)
    except KeyboardInterrupt:
        pass
    return tuple(found[k] for k in sorted(found)), len(found) == len(questions)
