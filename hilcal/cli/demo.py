"""`demo`: the whole story on a simulated cell with a hidden effect, which may be left in doubt."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hilcal import numbers
from hilcal.calibration.improvement import Improvement
from hilcal.campaign.campaign import Campaign
from hilcal.campaign.revisions import to_record
from hilcal.cli import simulating
from hilcal.cli.fitting import check_record, compute_errors, record_story
from hilcal.cli.options import check_seed, command
from hilcal.cli.planning import separates
from hilcal.cli.refining import revisions_json
from hilcal.cli.terminal import Terminal
from hilcal.config import load_config
from hilcal.design.next import plan_separating
from hilcal.design.planner import PlanRequest
from hilcal.design.summary import refuse
from hilcal.diagnosis.diagnosis import History
from hilcal.diagnosis.diagnosis import in_doubt as left_open
from hilcal.diagnosis.effect_ranking import candidates, rank_suspects
from hilcal.diagnosis.evidence import Evidence
from hilcal.diagnosis.verdict import diagnose, judge
from hilcal.discovery.discovery import LawSearch, agreement, laws_json
from hilcal.discovery.search import SAME_CORRELATION
from hilcal.drivers.simulated.injected_effects import HARD_TO_SEPARATE, RESEMBLING
from hilcal.drivers.simulated.rehearsal import (
    INVENTED,
    NO_EFFECT,
    RANDOM,
    Rehearsal,
    case_of_plan,
    check_choice,
    invented_law,
    simulate_plan,
)
from hilcal.effects.catalogue import Catalogue
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import Fit, fit
from hilcal.identification.linearisation import linearise
from hilcal.measuring.route import dry_run
from hilcal.names import quoted
from hilcal.present.calibration import improvement_report
from hilcal.present.diagnosis import (
    refined_laws,
    step_report,
    true_and_fitted,
    truth_table,
    verdict_line,
)
from hilcal.present.document import heading
from hilcal.present.fit import model_name
from hilcal.present.plan import next_report
from hilcal.present.progress import Say, working
from hilcal.present.story import chapters_of, errors_by_revision
from hilcal.present.verdict import message
from hilcal.procedure.next_plan import plan_of
from hilcal.procedure.procedure import Measure, Procedure
from hilcal.procedure.state import Files, Settings
from hilcal.refinement import Refinement
from hilcal.refinement import refine as refine_model
from hilcal.robot.catalogue import configs_dir
from hilcal.store.campaign_file import CampaignFile, may_write
from hilcal.store.plan import REFERENCE, Plan
from hilcal.store.revision import RevisionRecord
from hilcal.store.rows import content_hash
from hilcal.store.stored_texts import COMMAND

STRENGTH = 4.0  # Size of the hidden effect, in units of the noise: significant in so few readings
FIRST_POSES = 6  # Poses of the first campaign
CANDIDATES = 60  # Candidate poses of the first campaign. A choice: planning takes a second
ARMS_PER_PLAN = 4  # Arms drawn per plan. A choice
MAX_ARMS = 200  # Most arms drawn. 10 seeds took 1 to 32 arms and once 105, in 2 to 34 s
NOISE_DRAWS = 5  # Draws of the noise for which a rival has to be as good. A choice
MAX_CAMPAIGNS = 3
"""Most first campaigns measured until one leaves a doubt. Without devices the first one always
does; with other draws of the noise four in five do (38 of 48)."""
MAX_EVIDENCE_GAP = 2.0
"""Largest difference in log evidence between the hidden effect and its rival in each draw.
A choice: the difference scatters by about 1.3, and `SAME_EVIDENCE` is 3."""
SECOND_SHARE = 0.8
"""Poses of the second campaign, as a share of `--poses`: both campaigns together last about as long
as a single one otherwise."""


class FirstDiagnosis(NamedTuple):
    """A first diagnosis, and the plan that would settle it."""

    document: dict[str, object]
    record: RevisionRecord | None = None  # of the diagnosis; None where nothing is in doubt
    plan: Plan | None = None  # measurements that separate the suspects; None without a doubt


def doubtful_case(
    settings: simulating.RehearsalSettings, hide: str | None, say: Say, number: int = 0
) -> tuple[simulating.RehearsalSettings, Plan, bool]:
    """Draw an effect to hide and a small campaign that leaves it in doubt, by seed and `number`.

    A case is doubtful when a rival explains the readings about as well as the hidden effect in each
    of `NOISE_DRAWS` draws of the noise, and when the diagnosis of the first draw names both and
    says that further readings would separate them. Returned are settings, plan, and whether it is
    doubtful.
    """
    loads = settings.config.loads[1::2] or settings.config.loads
    quick = {"candidates": min(settings.config.planning.candidates, CANDIDATES), "against": ()}
    few = settings.config.with_keys("planning", **quick).model_copy(update={"loads": loads})
    strong = settings.config.with_keys("simulation", strength_sigma=STRENGTH)
    say("drawing an arm and a small campaign that leaves its effect in doubt")
    for k in range(MAX_ARMS):
        rng = np.random.default_rng([settings.seed, number, k])
        choice = hide or str(rng.choice(HARD_TO_SEPARATE))
        case = replace(settings, config=strong, choice=choice, seed=int(rng.integers(2**31)))
        if k % ARMS_PER_PLAN == 0:
            plan = simulating.first_plan(case, few, FIRST_POSES, lambda text: None)
        secret = case_of_plan(strong, plan, choice, case.seed, case.world)
        drawn = [simulate_plan(secret, plan, [case.seed, 1 + j]) for j in range(NOISE_DRAWS)]
        if choice == NO_EFFECT or (
            all(_resembled(r, case) for r in drawn) and _left_open(drawn[0], case)
        ):
            return case, plan, choice != NO_EFFECT
    return case, plan, False


def _fit(r: Rehearsal, catalogue: Catalogue) -> Fit:
    return fit(baseline(r.cell, r.readings, r.mode, catalogue), r.readings, r.mode)


def _resembled(r: Rehearsal, case: simulating.RehearsalSettings) -> bool:
    """Whether the hidden effect or a rival is significant, and a rival fits as well."""
    p = linearise(_fit(r, case.catalogue))
    effects = [e for e in candidates(p.fit) if e.name in (r.hidden, *RESEMBLING)]
    suspects = {s.effect: s for s in rank_suspects(p, effects)}
    hidden = suspects.pop(r.hidden, None)
    if hidden is None or not (hidden.passes or any(s.passes for s in suspects.values())):
        return False
    evidence = hidden.score.log_evidence
    return any(abs(s.score.log_evidence - evidence) < MAX_EVIDENCE_GAP for s in suspects.values())


def _left_open(r: Rehearsal, case: simulating.RehearsalSettings) -> bool:
    """Whether the diagnosis leaves the hidden effect in doubt, with separable rivals only."""
    d = judge(Evidence(_fit(r, case.catalogue)), History())
    return r.hidden in left_open(d) and all(rival.possible for rival in d.separability)


def diagnose_first(
    t: Terminal, r: Rehearsal, seed: int, first_plan: Plan, poses: int, catalogue: Catalogue
) -> FirstDiagnosis:
    """Diagnose a first campaign; plan what separates the suspects, at `SECOND_SHARE` of `poses`."""
    with working(t.progress) as say:
        say("fitting and diagnosing the first readings")
        fitted = _fit(r, catalogue)
        d = diagnose(fitted, say=say)
    document: dict[str, object] = {"verdict": d.verdict, "message": message(d), "suspects": []}
    suspects = left_open(d)
    if not suspects:
        return FirstDiagnosis(document)
    t.show(step_report(1, model_name(fitted.model.named), d))
    t.show(heading(f"Ambiguous between {numbers.names(suspects)}: readings that separate them"))
    with working(t.progress) as say:
        place = first_plan.joints(REFERENCE) if REFERENCE in first_plan.pose_names else None
        rng = np.random.default_rng(seed)
        request = PlanRequest(max(round(SECOND_SHARE * poses), 1))
        chosen = plan_separating(r.cell, fitted, suspects, request, rng, say, place)
        plan = plan_of(chosen, suspects)
        refuse(dry_run(r.cell, plan), "the plan")
    visited = len({s.pose for s in plan.steps} - {REFERENCE})
    t.show(next_report(chosen, visited, len(plan.steps)))
    document |= {"suspects": list(suspects), **separates(chosen)}
    record = to_record(fitted, d.to_dict(), None, content_hash(r.readings))
    return FirstDiagnosis(document, record, plan)


CELL = "demo_ur10e.toml"
POSES = 20  # Poses of the plan; a choice: with validation and corrected run it takes 3.5 minutes
VALIDATION = 10  # Poses of the validation campaign; a choice for the same reason


@command("""
    hide | --hide EFFECT | Effect that the simulated arm has and the model lacks; random; nothing;
        or invented: a law that is not in the catalogue.
    seed | --seed | Seed of all random numbers.
    output | -o --output RUN.hilcal | The campaign file to write.
    poses | --poses | Number of poses, see hilcal plan.
    validation | --validation | Number of poses at which the corrected arm is measured.
    without_devices | --without-devices | Simulate the readings without drivers and devices; takes
        seconds.
    ambiguous | --ambiguous | Measure only so much at first that the effect is in doubt, then what
        separates the suspects.
    """)
def demo(
    t: Terminal, catalogue: Catalogue, hide: str | None = None, seed: int | None = None,
    output: Path = Path("demo.hilcal"), poses: int = POSES, validation: int = VALIDATION,
    without_devices: bool = False, ambiguous: bool = False, record: Path | None = None,
    effects_from: list[Path] | None = None,
) -> None:  # fmt: skip
    """Run a complete campaign on a simulated cell, through the real drivers and protocols."""
    check_record(record)
    config = load_config(configs_dir() / "cells" / CELL)
    number = check_seed(config.simulation.seed if seed is None else seed)
    hidden = hide or config.simulation.hide
    world = invented_law(catalogue) if hidden == INVENTED else catalogue
    check_choice(hidden or RANDOM, world)
    _spare_measured(output)  # before the planning, which takes a while
    files = Files(output)
    for path in (files.validation, files.corrected):
        _spare_measured(path)
    case = simulating.RehearsalSettings(
        config, hidden or RANDOM, number, output, configs_dir() / "cells", catalogue, world
    )
    laws = None
    if hidden == INVENTED:  # the law is named after the campaign; its file is replaced
        word = re.sub(r"[^a-z0-9]+", "_", output.stem.lower()).strip("_")
        name = f"law_of_{word}" if word else "law"
        laws = LawSearch(output.absolute().parent, name, replacing=True)
    with _campaign(t, case, poses, without_devices, ambiguous) as (m, r, doubt):
        with working(t.progress) as say:
            model = baseline(r.cell, r.readings, r.mode, catalogue)
            refinement = refine_model(model, r.readings, r.mode, say, laws=laws)
            if laws is not None:
                laws.write(refinement.names)
                catalogue = refinement.fit.model.catalogue
            for step in refinement.steps:
                compute_errors(step.fit, say)
        settings = Settings(poses, validation, seed=number, readings=r.mode, hide=case.choice)
        p = Procedure(output, r.cell, catalogue, settings)
        with Campaign.open(output, catalogue) as o:
            if doubt is not None and doubt.record is not None:
                o.file.append_revision(doubt.record)
            p.resume(o.file)
            numbered = p.keep(o, refinement)
        chapters = chapters_of(numbered, refinement.steps)
        for c, s in zip(chapters, refinement.steps, strict=True):
            t.show(step_report(c.number, c.change, s.diagnosis))
        if laws is not None:
            t.show(refined_laws(laws))
        t.show(heading("The error, revision by revision"))
        t.show(errors_by_revision(chapters))
        truth = true_and_fitted(refinement.steps[-1].fit, r.world.truth)
        if truth:
            t.show(heading("Fitted and true parameters"))
            t.show([*truth_table(truth)])
        improved = _put_to_use(t, p, m.measure_missing, without_devices)
    ok, outcome = _judge(r, refinement) if laws is None else _judge_law(r, refinement, laws)
    t.show([verdict_line(refinement.diagnosis), "", heading(outcome)])
    if r.world.user_effect is not None and laws is not None:
        t.show(
            f"The simulated arm followed {r.world.user_effect.effect.summary}, computed with the "
            "mechanics of the model: this tests whether such a campaign reveals the law."
        )
    elif r.world.user_effect is not None:
        t.show(
            f"The simulated arm followed the law of {r.hidden} as the model has it: this tests "
            "whether such a campaign reveals the effect, not whether the law is right."
        )
    record_story(t, chapters, record)
    files_given = [*(effects_from or ()), *(() if laws is None else laws.files.values())]
    options = "".join(f" --effects-from {quoted(path)}" for path in files_given)
    t.show(f"\nThe campaign is in {output}. To look at it: hilcal view {quoted(output)}{options}")
    t.show("To write a report as one HTML page that begins with a certificate:")
    t.command(f"hilcal report {quoted(output)}{options}")
    t.document(
        campaign=str(output),
        hidden=r.hidden,
        strength_sigma=r.strength_sigma,
        seed=number,
        readings=r.mode,
        found=ok,
        **{} if laws is None else laws_json(laws),
        **{} if doubt is None else {"doubt": doubt.document},
        verdict=refinement.verdict,
        message=message(refinement.diagnosis),
        rejected=list(refinement.rejected),
        revisions=revisions_json(chapters),
        parameters=truth,
        truth=r.world.truth,
        compensation=None
        if improved is None
        else {
            "points": improved.everything.count,
            "before_m": improved.everything.before.mean_m,
            "after_m": improved.everything.after.mean_m,
            "stated_m": improved.everything.band_m,
            "inside": improved.everything.inside,
            "measured": improved.to_dict(),
        },
        diagnoses=[s.diagnosis.to_dict() for s in refinement.steps],
    )


def _spare_measured(path: Path) -> None:
    """Refuse to replace anything but a campaign of `demo`: readings cannot be made again."""
    may_write(path, True)
    if path.exists() and path.stat().st_size:
        with CampaignFile.open(path, read_only=True, check_revisions=False) as campaign:
            if not (campaign.about(COMMAND) or "").startswith("hilcal demo"):
                raise InputError(
                    f"{path}: exists and is no campaign of hilcal demo; it is not overwritten"
                )


@contextmanager
def _campaign(
    t: Terminal,
    case: simulating.RehearsalSettings,
    poses: int,
    without_devices: bool,
    ambiguous: bool,
) -> Iterator[tuple[simulating.RehearsedCampaign, Rehearsal, FirstDiagnosis | None]]:
    """Measure a campaign in a cell that lasts as the block; with `ambiguous` settle a doubt."""
    measured = simulating.in_process if without_devices else simulating.on_devices
    existed, first = case.output.exists(), case
    for tries in range(1, MAX_CAMPAIGNS + 1):
        another = False
        with working(t.progress) as say:
            if ambiguous:
                hidden = None if first.choice == RANDOM else first.choice
                case, plan, another = doubtful_case(first, hidden, say, tries - 1)
            else:
                plan = simulating.first_plan(case, case.config, poses, say)
        files = Files(case.output)
        for path in (files.validation, files.corrected):
            path.unlink(missing_ok=True)
        with measured(t, case, plan) as m:
            if existed and tries == 1:
                t.notice(f"{case.output} existed and is replaced")
            r = m.rehearsal
            _introduce(t, r, first.choice, first.seed)
            if not ambiguous:
                yield m, r, None
                return
            doubt = diagnose_first(t, r, first.seed, plan, poses, case.catalogue)
            last = doubt.plan is not None or not another or tries == MAX_CAMPAIGNS
            if doubt.plan is not None:
                before, r = len(r.readings), m.measure_plan(doubt.plan)
                new = len(r.readings) - before
                t.show(f"\n{new} readings were added. All {len(r.readings)} together:\n")
            elif last:
                t.show("These readings separate the suspects; another --seed or --hide may not.\n")
            if last:
                yield m, r, doubt
                return
        t.show("These readings separate the suspects: another arm is measured.\n")


def _put_to_use(t: Terminal, p: Procedure, measure: Measure, drawn: bool) -> Improvement | None:
    """Move the simulated arm to corrected targets, and report the errors measured there."""
    t.show(heading("Test of the corrected arm"))
    try:
        p.stop()
        while (step := p.next()).kind not in ("compare", "done"):
            if step.moves:
                p.measure(step, measure)
                continue
            with working(t.progress) as say:
                p.compute(step, say)
        improved = p.compare()
    except CannotAnswerError as error:
        t.show(f"{error}\n")
        return None
    t.show([*improvement_report(improved, None), ""])
    if drawn:
        t.show("The measurements were simulated without drivers and devices.\n")
    return improved


def _introduce(t: Terminal, r: Rehearsal, choice: str, seed: int) -> None:
    used = np.unique(r.readings.load)
    loads = [name for k, name in enumerate(r.readings.load_names) if k in used and name != "none"]
    poses = len(np.unique(r.readings.pose))
    secret = {
        NO_EFFECT: "No effect is hidden; the program does not know that.",
        RANDOM: "The simulated arm has one more effect than the model, drawn at random.",
        INVENTED: "The simulated arm follows a law that is not in the catalogue; the program does "
        "not know that.",
    }.get(
        choice,
        f"The simulated arm has the effect {r.hidden}, which the model lacks; the program does not "
        "know that.",
    )
    t.show(heading(f"A simulated {r.cell.arm.name} and a laser tracker, seed {seed}"))
    t.show(
        f"{poses} poses, unloaded and under {len(loads)} loads ({', '.join(loads)}): "
        f"{len(r.readings)} readings.\n{secret}"
    )
    kind = "deflections: loaded minus unloaded" if r.mode == "deflection" else "absolute positions"
    t.show(f"The model is fitted to {kind}.\n")


def _judge_law(r: Rehearsal, refinement: Refinement, laws: LawSearch) -> tuple[bool, str]:
    hidden_law = r.world.user_effect
    if hidden_law is None:
        return False, "No effect was hidden."
    ((_, true),) = hidden_law.truth.items()
    unit, factor = numbers.unit_for(hidden_law.effect.parameters[0].unit, [true])
    hidden = f"The hidden law was {hidden_law.effect.summary}, a = {factor * true:.3g} {unit}"
    soft = r.world.physics.joint_compliance
    moved, _ = hidden_law.displacements(r.cell, r.world.registration, soft, r.readings.states)
    for previous, step in pairwise(refinement.steps):
        d = next((d for d in laws.discoveries if d.laws and d.laws[0].name == step.added), None)
        if d is not None:
            law, same = d.laws[0], agreement(previous.fit, step.fit, moved)
            statement = f"The law found is {law.formula}; its correlation with the hidden one over"
            return same >= SAME_CORRELATION, f"{hidden}. {statement} these readings is {same:.3f}."
    return False, f"{hidden}. It was not found."


def _judge(r: Rehearsal, refinement: Refinement) -> tuple[bool, str]:
    named = refinement.fit.model.named  # an effect may be added, and later go into a background
    added = [s.added for s in refinement.steps if s.added in named]
    if r.hidden == NO_EFFECT:
        if not added and refinement.verdict == "adequate":
            return True, "No effect was hidden, and none was found."
        verdict = refinement.verdict.replace("_", " ")
        return False, f"No effect was hidden, but the verdict is {verdict}."
    hidden = f"The hidden effect was {r.hidden}, at {r.strength_sigma:g} times the noise"
    suspects = refinement.steps[0].diagnosis.suspects
    same = suspects[0].same_as if suspects else ()
    if r.hidden in added:
        others_added = [a for a in added if a != r.hidden]
        ending = f" Added as well: {numbers.names(others_added)}." if others_added else ""
        return True, f"{hidden}. It was found and added.{ending}"
    if added and r.hidden in same:
        return True, f"{hidden}. It was named among those that these readings do not separate."
    return False, f"{hidden}. It was not found."
