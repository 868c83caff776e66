"""The curve of a law from a file, beside the readings: on a page, in the viewer."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from hilcal.discovery import shapes
from hilcal.discovery.amplitudes import Amplitude, Factor, variables
from hilcal.discovery.curve import drawn_laws
from hilcal.discovery.law import Form, LawPart, source_of_form
from hilcal.discovery.sites import sites
from hilcal.effects.catalogue import installed
from hilcal.effects.check import example_cell, example_situation, example_states
from hilcal.effects.from_file import effects_of
from hilcal.identification.baseline import with_effects
from hilcal.identification.fit import Fit, fit
from hilcal.present.charts import curve_chart
from hilcal.present.document import says
from hilcal.present.story import Chapter, build_story
from hilcal.present.viewer import save
from tests.support.campaigns import NOTHING, campaign
from tests.support.recordings import rows

SITUATION = example_situation(example_cell(), example_states(example_cell()))
KNOWN = {v.symbol: v for v in variables(SITUATION)}
JOINT = sites(6)[2]
Q5 = Factor(KNOWN["q_5"], shapes.COS, (1.0,))
PRODUCT = Form((LawPart(JOINT, Amplitude((Q5, Factor(KNOWN["τ_3"], shapes.LINEAR))), 0),))
WAVE = Form((LawPart(JOINT, Amplitude((Factor(KNOWN["q_3"], shapes.COS, (96.0,)),)), 0),))


@cache
def fitted(form: Form) -> Fit:
    """A fit with a law that is not there, to readings of 12 poses."""
    found = campaign(NOTHING, "deflection", poses=12)
    source = source_of_form(form, "twisted").encode()
    file = effects_of(source, Path("twisted.py"))
    known = replace(installed().with_effects(*file.effects), files=(file,))
    names = ("base_frame", "joint_compliance", "twisted")
    model = with_effects(found.cell, found.readings, "deflection", names, {}, known)
    return fit(model, found.readings, "deflection")


@pytest.mark.parametrize(
    ("form", "of", "over"),
    [(PRODUCT, "dq_3/τ_3", "q_5"), (WAVE, "dq_3", "q_3 within a period of 2π/96")],
)
def test_a_law_is_drawn_over_what_its_formula_names(form: Form, of: str, over: str) -> None:
    made = fitted(form)
    (found,) = drawn_laws(made)
    assert (found.name, found.formula, found.acts_on) == ("twisted", form.text(), ("joint 3",))
    (c,) = found.curves
    assert (c.of, c.quantity) == (of, over)
    a = made.theta[-1]
    truth = a * np.cos(c.x if "q_5" in over else 96 * c.x)
    off = (c.y - truth) / c.std  # the residual of each reading, in the noise of the site's motion
    assert 0.5 < float(np.sqrt(np.mean(off**2))) < 1.5
    inside = np.interp(c.x, *c.line)
    assert np.abs(inside - truth).max() < 0.1 * abs(a)


def test_a_law_is_seen_on_the_page_and_in_the_viewer(tmp_path: Path) -> None:
    made = fitted(PRODUCT)
    before = replace(made.model, effects=made.model.effects[:-1])
    chapters = [
        Chapter(1, None, fit(before, made.readings, made.mode), None),
        Chapter(2, "twisted", made, None),
    ]
    story = build_story(chapters)
    assert story.revisions[0].laws == ()
    (one,) = story.revisions[1].laws
    assert one.x_label == "q_5 [°]"
    assert one.y_label == "dq_3/τ_3 of joint 3 [µrad/(N·m)]"
    assert dict(one.facts)["coefficients"].startswith("a = ")
    assert "dq_3 = a·cos(q_5)·τ_3" in says(curve_chart(one))
    save(story, tmp_path / "x.rrd")
    law = rows(tmp_path / "x.rrd", "/law/law", "BarChart:values", "revision")
    assert set(law) == {2}


def test_a_model_of_the_catalogue_has_no_laws() -> None:
    made = fitted(WAVE)
    plain = replace(made.model, effects=made.model.effects[:-1], catalogue=installed())
    assert drawn_laws(fit(plain, made.readings, made.mode)) == ()
