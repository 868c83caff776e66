"""Campaign files as the commands see them: open, fit, and keep what was fitted."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from hilcal.cell import Cell, cell_from_config
from hilcal.cli.terminal import Terminal
from hilcal.config import CellConfig
from hilcal.data.campaign import Campaign
from hilcal.data.readings import Readings
from hilcal.data.records import content_hash
from hilcal.data.revision import RevisionRecord
from hilcal.data.whitening import MODES, SCALINGS, Mode, Scaling, usual_mode
from hilcal.diagnose.diagnosis import Diagnosis, History
from hilcal.diagnose.verdict import diagnose
from hilcal.effects.catalogue import Catalogue, installed
from hilcal.effects.options import Options
from hilcal.effects.written import chosen_options, read_effects_text, write_effect
from hilcal.errors import InputError
from hilcal.identify.baseline import baseline
from hilcal.identify.fit import Fit, fit
from hilcal.identify.full_covariance import campaign_readings
from hilcal.model import Model
from hilcal.report.build_story import Chapter, build_story
from hilcal.report.diagnosis_document import to_json
from hilcal.report.progress import Say, working
from hilcal.revisions import (
    chain,
    check_sources,
    history,
    mode_of,
    restore,
    restore_model,
    to_record,
)
from hilcal.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Opened:
    """An open campaign.

    Attributes:
        path: the file.
        campaign: open for appending.
        config: the cell's configuration.
        cell: the cell.
        readings: all readings.
        catalogue: the effects that a model can have.
    """

    path: Path
    campaign: Campaign
    config: CellConfig
    cell: Cell
    readings: Readings
    catalogue: Catalogue

    def latest(self) -> RevisionRecord | None:
        """Return the latest revision, if there is any."""
        records = self.campaign.revisions()
        return records[-1] if records else None

    def mode(self, asked: str | None) -> Mode:
        """Kind of readings: as asked, else as in the latest revision, else what they allow.

        Raises:
            InputError: an unknown kind.
        """
        if asked is not None:
            return choice(asked, MODES, "--readings")
        record = self.latest()
        return usual_mode(self.readings) if record is None else mode_of(record)

    def store(
        self,
        found: Fit,
        diagnosis: Diagnosis | None,
        added: str | None,
        removed: str | None = None,
    ) -> int:
        """Append a fit; returns its revision number."""
        document = None if diagnosis is None else to_json(diagnosis)
        record = to_record(found, document, added, content_hash(self.readings), removed)
        return self.campaign.append_revision(record)

    def restore(self, record: RevisionRecord) -> Fit:
        """Find a stored fit again.

        Raises:
            InputError: its readings or its effects are not at hand as they were then.
        """
        check_sources(record, self.path, self.catalogue)
        return restore(record, self.cell, self.readings, self.catalogue)

    def model_of(self, record: RevisionRecord) -> tuple[Model, Floats]:
        """Return model and parameters of a stored fit; raises as `restore` does."""
        check_sources(record, self.path, self.catalogue)
        return restore_model(record, self.cell, self.readings, self.catalogue)

    def history(self, number: int | None = None) -> History:
        """Return how the model of a revision was reached, by default of the latest."""
        return history(chain(self.campaign.revisions()[:number]))

    def latest_fit(self, t: Terminal, say: Say) -> tuple[int, Fit]:
        """Return the latest revision as a fit; without any, make and store the baseline."""
        record = self.latest()
        if record is not None:
            say(f"restoring revision {record.number}")
            return record.number, self.restore(record)
        mode = self.mode(None)
        model = baseline(self.cell, self.readings, mode, self.catalogue)
        say(f"fitting {' + '.join(model.names) or 'the nominal arm'}")
        found = fit(model, self.readings, mode)
        number = self.store(found, None, None)
        t.notice(
            f"no revision yet: made the baseline, revision {number} "
            f"({' + '.join(model.names) or 'the nominal arm'}, {mode} readings)"
        )
        return number, found

    def chapters(self, t: Terminal, say: Say) -> list[Chapter]:
        """Return the latest revision and those that it was made from, diagnosed."""
        if self.latest() is None:
            self.latest_fit(t, say)
        out = []
        for record in chain(self.campaign.revisions()):
            say(f"restoring revision {record.number}")
            found = self.restore(record)
            judged = None
            if found.scaling == "gc":
                say(f"diagnosing revision {record.number}")
                judged = diagnose(found, self.history(record.number), say)
            out.append(Chapter(record.number, record.added, found, judged, record.removed))
        return out


@contextmanager
def open_run(path: Path, catalogue: Catalogue | None = None) -> Iterator[Opened]:
    """Open a campaign file.

    Args:
        path: the file.
        catalogue: the effects that a model can have; the installed ones unless given.

    Raises:
        InputError: not a sound campaign, or without readings.
    """
    with Campaign.open(path) as campaign:
        config = CellConfig.from_json(campaign.config_json)
        cell = cell_from_config(config, Path(campaign.base_dir))
        readings = campaign_readings(campaign, cell, config)
        yield Opened(path, campaign, config, cell, readings, catalogue or installed())


def choice(name: str, valid: tuple[Mode, ...], option: str) -> Mode:
    """Check a kind of readings.

    Raises:
        InputError: lists the valid ones.
    """
    for known in valid:
        if name == known:
            return known
    raise InputError(f"{option} {name!r} is unknown; valid: {', '.join(valid)}")


def scalings(name: str) -> tuple[Scaling, ...]:
    """Return the scalings that `--scaling` asks for; the one that is kept comes last.

    Raises:
        InputError: lists the valid ones.
    """
    if name == "all":
        return SCALINGS
    found = tuple(s for s in SCALINGS if s == name)
    if not found:
        raise InputError(f"--scaling {name!r} is unknown; valid: {', '.join(SCALINGS)}, all")
    return found


def wanted_effects(text: str | None, catalogue: Catalogue) -> dict[str, dict[str, object]] | None:
    """Read `--effects "a, b(option=value)"`: options by name, see `read_effects_text`.

    Raises:
        InputError: an unknown name (lists the valid ones), one that is there twice, or options
            that cannot be read.
    """
    if text is None:
        return None
    wanted = read_effects_text(text, "--effects", catalogue)
    if not wanted:
        raise InputError("--effects is empty; give one name or several, separated by commas")
    return wanted


def effect_names(text: str | None, catalogue: Catalogue) -> tuple[str, ...] | None:
    """Read names of effects where they cannot have options; raises as `wanted_effects` does."""
    wanted = wanted_effects(text, catalogue)
    for name, options in (wanted or {}).items():
        if options:
            raise InputError(f"--effects: {name} takes no options here; valid: {name}")
    return None if wanted is None else tuple(wanted)


def check_options(o: Opened, wanted: Mapping[str, Options]) -> None:
    """Refuse options of effects before any work is done.

    Raises:
        InputError: an unknown option, a bad value, or readings that lack what an effect needs.
    """
    for name, options in wanted.items():
        o.catalogue.make(name, o.cell, o.readings.states, options).prior_std()


def chosen(found: Fit) -> dict[str, dict[str, object]]:
    """Options of the effects of a fit that are not the usual ones, by name."""
    return chosen_of(found.model, found.readings)


def chosen_of(model: Model, readings: Readings) -> dict[str, dict[str, object]]:
    """Options of the effects of a model that are not the usual ones for its readings, by name."""
    options = {e.name: chosen_options(e, readings.states, readings.m) for e in model.effects}
    return {name: given for name, given in options.items() if given}


def titles(model: Model, readings: Readings) -> tuple[str, ...]:
    """Names of a model's effects, with the options that are not the usual ones."""
    given = chosen_of(model, readings)
    return tuple(write_effect(name, given.get(name, {})) for name in model.names)


def check_record(path: Path | None) -> None:
    """Refuse a recording that cannot be written before any work is done.

    Raises:
        InputError: no such folder.
    """
    if path is not None and not path.absolute().parent.is_dir():
        raise InputError(f"--record {path}: no folder {path.absolute().parent}; make it first")


def record_story(t: Terminal, chapters: list[Chapter], path: Path | None) -> None:
    """Write a recording, where it is asked for."""
    if path is None:
        return
    from hilcal.report.viewer import save  # loads the viewer's library, which takes a while

    with working(t.progress) as say:
        say(f"writing {path}")
        save(build_story(chapters), path)
    t.notice(f"recorded {path}; open it with: rerun {path}")
