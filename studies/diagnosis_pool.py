"""Cases on several processes or a cluster: can be stopped, and give reproducible results."""

from collections.abc import Callable, Sequence

from hilcal.engine import Advance, open_engine
from studies.diagnosis import DiagnosisCase, DiagnosisOutcome

Run = Callable[[DiagnosisCase], DiagnosisOutcome]


def run_all(
    questions: Sequence[DiagnosisCase],
    run: Run,
    jobs: int | None,
    advance: Advance,
    scheduler: str | None = None,
) -> tuple[tuple[DiagnosisOutcome, ...], bool]:
    """Run cases, and return the finished ones in the order of the questions, and whether all are.

    Ctrl-C ends the run: running cases are dropped, finished ones are returned.

    Args:
        questions: settings of the cases.
        run: runs a case; a function of a module, which other processes find by its name.
        jobs: number of processes; 1 runs all in this one, None one on each processor.
        advance: called after each case.
        scheduler: address of a cluster, instead of processes of this machine.
    """
    finished: dict[int, DiagnosisOutcome] = {}
    try:
        with open_engine(jobs, scheduler) as engine:
            for number, outcome in engine.results(run, questions):
                finished[number] = outcome
                advance(1)
    except KeyboardInterrupt:
        pass
    return tuple(finished[k] for k in sorted(finished)), len(finished) == len(questions)
