"""`report`: collects the results of a campaign, and writes them as one HTML page."""

import hashlib
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import hilcal
from hilcal.campaign.campaign import Campaign, opened
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.fit import Fit, fit
from hilcal.names import quoted
from hilcal.present.html import FirstScreen
from hilcal.present.html.report import ReportContent, TestCampaign, first_screen, page
from hilcal.present.progress import Say
from hilcal.present.story import build_story, of_left_out
from hilcal.procedure.state import Files
from hilcal.readings.whitening import SCALINGS, Scaling
from hilcal.store.overview import overview
from hilcal.store.procedure_log import IMPROVED, ProcedureLog
from hilcal.store.revision import utc_now
from hilcal.store.run_log import PLAN, RunLog
from hilcal.transfer.compare import validate
from hilcal.transfer.fleet import Fleet
from hilcal.whole_file import PAGE, replace_file, spare_other


@dataclass(frozen=True, slots=True)
class ReportOptions:
    """The options of `report`."""

    later: Campaign | None = None
    validation: Campaign | None = None
    limit_m: float | None = None
    operator: str = ""
    revision: int | None = None
    appendix: bool = False
    register: bool = False


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
    register: bool = False,
    say: Say = lambda text: None,
) -> Path:
    """Write the results of a campaign as one HTML page, which needs neither hilcal nor a network.

    >>> with hc.Campaign.open(RUN) as run:
    ...     page = hc.report(run, REPORT, operator="A. Miller", limit_m=0.5e-3)
    >>> page.suffix
    '.html'

    Args:
        run: the campaign, or its path; without a revision the baseline is fitted, but not stored.
        path: the page; an existing file is replaced. None: RUN.html in the campaign's directory.
        later: a later campaign of the same arm, for a page that compares the two.
        validation: a campaign that was never fitted, to test the predictions; None: the validation
            campaign of `calibrate`, if there is one.
        limit_m: the largest 3-D position error allowed, m; None: [limits] accuracy_m of the
            campaign's configuration.
        operator: the person responsible for the measurement.
        revision: number of the revision; None: the one in use.
        appendix: add details for experts: plots of rejected suspects and of each joint,
            correlations, the same model by each scaling, commands, hashes of revisions.
        register: the tracker was set up anew for the validation: estimate its registration first.
        say: takes progress, one line each.

    Raises:
        InputError: no such revision, the page cannot be written, or see `validate` and `compare`.
        CannotAnswerError: the readings do not determine the baseline, or see `validate`.
    """
    options = ReportOptions(later, validation, limit_m, operator, revision, appendix, register)
    with opened(run) as campaign:
        page = campaign.path.with_suffix(".html") if path is None else Path(path)
        write_report(campaign, page, options, say)
    return page


def write_report(
    run: Campaign, path: Path, options: ReportOptions, say: Say = lambda text: None
) -> FirstScreen:
    """Write a page as `report` does, and return its first screen."""
    later, validation = options.later, options.validation
    if path.resolve() in {c.path.resolve() for c in (run, later, validation) if c is not None}:
        raise InputError(f"{path}: this is the campaign itself; name another file for the page")
    spare_other(path, "a page", PAGE)
    if not path.absolute().parent.is_dir():  # before minutes of work
        raise InputError(f"{path}: cannot be written, there is no folder {path.absolute().parent}")
    if later is not None:
        alone = (validation, options.limit_m, options.appendix or None, options.register or None)
        if any(option is not None for option in alone):
            raise InputError(
                "a comparison of two campaigns takes no --validation, --register, --limit or "
                "--appendix"
            )
        from hilcal.present.html.other_pages import comparison_page, comparison_screen
        from hilcal.transfer.compare import compare

        comparison = compare(run, later, options.revision, say=say)
        names = ((run.path.name, _sha256(run.path)), (later.path.name, _sha256(later.path)))
        html = comparison_page(comparison, names, options.operator, utc_now(), hilcal.__version__)
        screen = comparison_screen(comparison, run.path.name)
    else:
        with ExitStack() as stack:
            default = Files(run.path).validation
            if validation is None and default.is_file():
                say(f"using {default.name} in the same folder as validation campaign")
                opened = Campaign.open(default, run.catalogue, read_only=True)
                validation = stack.enter_context(opened)
            content = content_of(run, replace(options, validation=validation), say)
        say("writing the page")
        html, screen = page(content), first_screen(content)
    replace_file(path, html)
    return screen


def content_of(
    run: Campaign, options: ReportOptions | None = None, say: Say = lambda text: None
) -> ReportContent:
    """Collect the content of a report of one campaign; raises as `report` does."""
    options = options or ReportOptions()
    validation, limit_m, revision = options.validation, options.limit_m, options.revision
    record, chapters = run.in_use(revision), run.chapters(say, revision)
    say("preparing the story")
    fitted, story, name = chapters[-1].fit, build_story(chapters), quoted(run.path.name)
    number = "" if record is None else f" --revision {record.number}"
    commands = [f"hilcal info {quoted(run.path.name)}"]
    commands += [f"hilcal {c} {name}{number}" for c in ("compare", "diagnose")]
    tested = corrected = None
    if validation is not None:
        prediction = validate(run, validation, record, limit_m, register=options.register, say=say)
        tested = TestCampaign(validation.path.name, _sha256(validation.path), prediction)
        anew = " --register" * options.register
        commands.append(f"hilcal validate {name} {quoted(validation.path.name)}{number}{anew}")
    gain = ProcedureLog(run.file).last(IMPROVED)
    if gain and record and gain["revision"] == record.number:
        corrected = gain  # measured with this revision
    return ReportContent(
        name=run.path.name,
        sha256=_sha256(run.path),
        created=utc_now(),
        version=hilcal.__version__,
        overview=overview(run.file),
        covariance=run.covariance_parts,
        chapters=tuple(chapters),
        stored=record is not None,
        story=story,
        left_out=of_left_out(story.revisions[-1], fitted),
        scalings=_scalings(fitted, say) if options.appendix else {},
        plan=None if run.file.about(PLAN) is None else RunLog(run.file).plan,
        test=tested,
        corrected=corrected,
        limit_m=run.config.limits.accuracy_m if limit_m is None else limit_m,
        operator=options.operator,
        commands=tuple(commands),
        appendix=options.appendix,
    )


def write_fleet_report(fleet: Fleet, directory: Path, path: Path) -> None:
    """Write the results of a fleet as one HTML page."""
    from hilcal.present.html.other_pages import fleet_page

    spare_other(path, "a page", PAGE)
    replace_file(path, fleet_page(fleet, directory.resolve().name, utc_now(), hilcal.__version__))


def _scalings(last: Fit, say: Say) -> dict[Scaling, Fit]:
    out: dict[Scaling, Fit] = {}
    outlier = last.outlier if last.model.background else None
    for s in SCALINGS if last.scaling == "gc" else ():
        say(f"fitting with scaling {s}")
        try:
            args = last.model, last.readings, last.mode, s
            out[s] = last if s == "gc" else fit(*args, outlier=outlier)
        except CannotAnswerError:
            continue
    return out


def _sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
