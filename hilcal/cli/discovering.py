"""`discover`: laws in readable form for what the catalogue does not explain."""

from pathlib import Path
from typing import Annotated

from hilcal.calibration.calibration import Calibration
from hilcal.campaign.campaign import Campaign
from hilcal.cli.fits import check_options, fit_of, wanted_effects
from hilcal.cli.options import (
    EffectsFrom,
    Json,
    Revision,
    Run,
    catalogue_with,
    check_folder,
    option,
)
from hilcal.cli.terminal import terminal
from hilcal.diagnosis.serial_noise import with_serial_noise
from hilcal.discovery.discovery import discover as search
from hilcal.discovery.discovery import rival_sources
from hilcal.discovery.document import discovery_json
from hilcal.effects.catalogue import Catalogue
from hilcal.effects.check import NAME
from hilcal.effects.protocol import FRAME_ROLES
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.baseline import baseline, with_effects
from hilcal.identification.fit import fit
from hilcal.names import quoted
from hilcal.present.diagnosis import discovery_report, silence
from hilcal.present.fit import model_name
from hilcal.present.progress import working
from hilcal.whole_file import replace_file


def discover(
    run: Run,
    output: Annotated[Path, option("-o --output F.py", "The effect, to be edited.")],
    against: Annotated[
        str | None,
        option(
            "--against MODEL",
            "Beside this model instead of the revision in use: effects A,B; baseline; or the "
            "file of an exported calibration, whose effects are fitted to this run.",
        ),
    ] = None,
    alternatives: Annotated[
        bool,
        option(
            "--alternatives",
            "Also write laws that these readings do not tell from it: F_or_1.py; hilcal next "
            "plans what separates them.",
        ),
    ] = False,
    revision: Revision = None,
    effects_from: EffectsFrom = None,
    as_json: Json = False,
) -> None:
    """Search a law for what no effect explains, and write it as an effect."""
    t, catalogue = terminal(as_json), catalogue_with(effects_from)
    wanted = _effects_against(against, catalogue)
    name = output.stem
    if output.suffix != ".py" or not NAME.fullmatch(name) or name in catalogue.names:
        raise InputError(
            f"-o {output}: the effect is called after its file; valid: lower-case letters, digits "
            "and _, a letter first, .py at the end, and no name of the catalogue"
        )
    if wanted is not None and revision is not None:
        raise InputError("--against and --revision: give one of them")
    check_folder(output, f"-o {output}")
    with Campaign.open(run, catalogue, read_only=True) as o, working(t.progress) as say:
        number: int | None = None
        if wanted is None:
            number, found = fit_of(t, o, say, revision)
        else:
            check_options(o, wanted)
            model = (
                with_effects(o.cell, o.readings, o.mode(), wanted, wanted, catalogue)
                if wanted
                else baseline(o.cell, o.readings, o.mode(), catalogue)
            )
            say(f"fitting {model_name(model.named)}")
            found = with_serial_noise(fit(model, o.readings, o.mode()))
        d = search(found, say, name)
    document = {"revision": number, **discovery_json(d), "written": None}
    t.show(discovery_report(d))
    if not d.laws:
        t.document(document, CannotAnswerError(silence(d)))
    rivals = rival_sources(d) if alternatives else {}
    written = {name: d.source, **rivals}
    places = {own: output.with_name(f"{own}.py") for own in written}
    for own, source in written.items():
        replace_file(places[own], source)
    t.show(
        f"\n{output} has the first law as the effect {name}. Add it, and judge the model with it:"
    )
    t.command(f"hilcal add {quoted(run)} {name} --effects-from {quoted(output)}")
    t.command(f"hilcal diagnose {quoted(run)} --effects-from {quoted(output)}")
    if alternatives and not rivals:
        t.show("No other law explains these readings as well.")
    if rivals:
        t.show("Plan the measurements that separate it from what explains these readings as well:")
        files = " ".join(f"--effects-from {quoted(places[own])}" for own in written)
        t.command(f"hilcal next {quoted(run)} -o PLAN.json --suspects {','.join(written)} {files}")
    others = [{"name": own, "written": str(places[own])} for own in rivals]
    t.document({**document, "written": str(output), "alternatives": others})


def _effects_against(
    model: str | None, catalogue: Catalogue
) -> dict[str, dict[str, object]] | None:
    """Read `--against`: options of effects by name; none of them for the baseline."""
    if model == "baseline":
        return {}
    if model is None or not model.endswith(".json"):
        return wanted_effects(model, catalogue)
    return {
        e.name: {key: value for key, value in e.options.items() if not key.startswith("prior_")}
        for e in Calibration.load(model, catalogue).model.effects
        if e.role not in FRAME_ROLES
    }
