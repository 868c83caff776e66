"""`report`: collects what a campaign says, and writes it as one HTML page."""

import hashlib
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import hilcal
from hilcal.campaign.campaign import Campaign, opened
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.fit import Fit, fit
from hilcal.names import quoted
from hilcal.present.html import FirstScreen
from hilcal.present.html.report import ReportContent, Tested, first_screen, page
from hilcal.present.story import build_story, of_left_out
from hilcal.procedure.state import IMPROVED, Files
from hilcal.readings.whitening import SCALINGS, Scaling
from hilcal.store.overview import overview
from hilcal.store.procedure_log import ProcedureLog
from hilcal.store.revision import utc_now
from hilcal.store.run_log import PLAN, RunLog
from hilcal.transfer.fleet import Fleet
from hilcal.validation import validate
from hilcal.whole_file import replace_file

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Asked:
    """What a report is asked to say; each as in `report`."""

    later: Campaign | None = None
    validation: Campaign | None = None
    limit_m: float | None = None
    operator: str = ""
    revision: int | None = None
    appendix: bool = False


def report(
    run: Campaign | str | Path,
    path: str | Path | None = None,
    *,
    later: Campaign | None = None,
    validation: Campaign | None = None,
    limit_m: float | None = None,
    operator: str = "",
    revision: int | None = None,
    appendix: bool = False,
    say: Say = lambda text: None,
) -> Path:
    """Write the story of a campaign as one HTML page, which needs neither hilcal nor a network.

    >>> with hc.Campaign.open(RUN) as run:
    ...     page = hc.report(run, REPORT, operator="A. Miller", limit_m=0.5e-3)
    >>> page.suffix
    '.html'

    Args:
        run: the campaign, or its path; without a revision the baseline is fitted, and not kept.
        path: of the page; a file that is there is replaced. RUN.html beside the campaign if None.
        later: a later campaign of the same arm: the page compares the two.
        validation: a campaign that was never fitted: the page says how well it is predicted; where
            None, the one that `calibrate` has put beside the campaign, if there is one.
        limit_m: the largest 3-D position error that is allowed, m; that of the campaign's
            configuration, [limits] accuracy_m, where None.
        operator: who answers for the measurement.
        revision: what the page is about; the one in use where None.
        appendix: add what only another expert asks for: plots of rejected suspects and of each
            joint, correlations, the same model by each scaling, commands, hashes of revisions.
        say: takes progress, one line each.

    Raises:
        InputError: no such revision, the page cannot be written, or see `validate` and `compare`.
        CannotAnswerError: the readings do not determine the baseline, or see `validate`.
    """
    asked = Asked(later, validation, limit_m, operator, revision, appendix)
    with opened(run) as campaign:
        page = campaign.path.with_suffix(".html") if path is None else Path(path)
        write_report(campaign, page, asked, say)
    return page


def write_report(
    run: Campaign, path: Path, asked: Asked, say: Say = lambda text: None
) -> FirstScreen:
    """Write a page as `report` does, and return what it says first."""
    later, validation = asked.later, asked.validation
    if path.resolve() in {c.path.resolve() for c in (run, later, validation) if c is not None}:
        raise InputError(f"{path}: this is the campaign itself; name another file for the page")
    if not path.absolute().parent.is_dir():  # said before minutes of work
        raise InputError(f"{path}: cannot be written, there is no folder {path.absolute().parent}")
    if later is not None:
        if validation is not None or asked.limit_m is not None or asked.appendix:
            raise InputError(
                "a comparison of two campaigns takes no --validation, --limit or --appendix"
            )
        from hilcal.present.html.other_pages import comparison_page, comparison_screen
        from hilcal.transfer.compare import compare

        found = compare(run, later, asked.revision, say=say)
        names = ((run.path.name, _sha256(run.path)), (later.path.name, _sha256(later.path)))
        html = comparison_page(found, names, asked.operator, utc_now(), hilcal.__version__)
        first = comparison_screen(found, run.path.name)
    else:
        with ExitStack() as stack:
            beside = Files(run.path).validation
            if validation is None and beside.is_file():
                say(f"taking {beside.name}, which stands beside it, as validation campaign")
                opened = Campaign.open(beside, run.catalogue, read_only=True)
                validation = stack.enter_context(opened)
            m = content_of(run, replace(asked, validation=validation), say)
        say("writing the page")
        html, first = page(m), first_screen(m)
    replace_file(path, html)
    return first


def content_of(
    run: Campaign, asked: Asked | None = None, say: Say = lambda text: None
) -> ReportContent:
    """Collect what a report of one campaign says; errors as of `report`."""
    asked = asked or Asked()
    validation, limit_m, revision = asked.validation, asked.limit_m, asked.revision
    record = run.in_use(revision)
    chapters = run.chapters(say, revision)
    last = chapters[-1].fit
    say("preparing the story")
    name = quoted(run.path.name)
    number = "" if record is None else f" --revision {record.number}"
    commands = [f"hilcal info {quoted(run.path.name)}"]
    commands += [f"hilcal {c} {name}{number}" for c in ("compare", "diagnose")]
    tested = corrected = None
    if validation is not None:
        found = validate(run, validation, record, limit_m, say=say)
        tested = Tested(validation.path.name, _sha256(validation.path), found)
        commands.append(f"hilcal validate {name} {quoted(validation.path.name)}{number}")
    improved = ProcedureLog(run.file).last(IMPROVED)
    if improved and record and improved["revision"] == record.number:
        corrected = improved  # the gain that was measured with this very revision
    story = build_story(chapters)
    return ReportContent(
        name=run.path.name,
        sha256=_sha256(run.path),
        made=utc_now(),
        version=hilcal.__version__,
        overview=overview(run.file),
        covariance=run.covariance_parts,
        chapters=tuple(chapters),
        stored=record is not None,
        story=story,
        left_out=of_left_out(story.revisions[-1], last),
        scalings=_scalings(last, say) if asked.appendix else {},
        plan=None if run.file.about(PLAN) is None else RunLog(run.file).plan,
        tested=tested,
        corrected=corrected,
        limit_m=run.config.limits.accuracy_m if limit_m is None else limit_m,
        operator=asked.operator,
        commands=tuple(commands),
        appendix=asked.appendix,
    )


def write_fleet_report(found: Fleet, directory: Path, path: Path) -> None:
    """Write what is known of a fleet as one HTML page.

    Raises:
        InputError: it cannot be written.
    """
    from hilcal.present.html.other_pages import fleet_page

    replace_file(path, fleet_page(found, directory.resolve().name, utc_now(), hilcal.__version__))


def _scalings(last: Fit, say: Say) -> dict[Scaling, Fit]:
    """Fit the last model with each scaling, where its own is gc."""
    out: dict[Scaling, Fit] = {}
    for s in SCALINGS if last.scaling == "gc" else ():
        say(f"fitting with scaling {s}")
        try:
            out[s] = last if s == "gc" else fit(last.model, last.readings, last.mode, s)
        except CannotAnswerError:
            continue
    return out


def _sha256(path: Path) -> str:
    """Hash of a campaign file as it is on the disk."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
