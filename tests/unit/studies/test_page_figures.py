"""The figures of the pages say what the pages say of them."""

import json

import numpy as np
import pytest

from studies.page_figures import NAMES, figures
from tests.support.paths import ROOT


@pytest.fixture(scope="module")
def drawn():
    """All figures by their name, as plotly draws them."""
    made = figures(ROOT / "docs" / "measured")
    assert tuple(made) == NAMES
    return {
        name.removeprefix("images/").removesuffix(".svg"): json.loads(f.to_json(engine="json"))
        for name, f in made.items()
    }


def traces(figure):
    return {t["name"]: t for t in figure["data"] if "name" in t}


def numbers(values):
    """Numbers that plotly wrote as a list, or packed."""
    if isinstance(values, dict):
        import base64

        return np.frombuffer(base64.b64decode(values["bdata"]), dtype=values["dtype"])
    return np.asarray(values, dtype=float)


@pytest.mark.slow
def test_figures_show_what_their_pages_say(drawn):
    scaling = {name: numbers(t["x"]) for name, t in traces(drawn["scaling"]).items()}
    assert scaling["gc"].max() < 1.1 < 1.2 < scaling["none"].min()

    bars = [numbers(t["y"]) for t in drawn["noise-terms"]["data"]]
    assert all(bar.min() > 0 for bar in bars)
    assert np.all(bars[2] > bars[0])  # the arm scatters by more than the laser's range

    shared = numbers(drawn["noise-shared"]["data"][0]["z"])
    size = int(np.sqrt(shared.size))
    np.testing.assert_allclose(np.diag(shared.reshape(size, size)), 1.0)
    np.testing.assert_allclose(np.diag(shared.reshape(size, size), 3), 0.5, atol=0.1)

    fitted = drawn["noise-misjudged"]["data"][0]
    factor, found = numbers(fitted["x"]), numbers(fitted["y"])
    high, low = (numbers(fitted["error_y"][k]) for k in ("array", "arrayminus"))
    inside = (found - low <= factor**2) & (factor**2 <= found + high)
    assert inside.all()
    assert fitted["text"][2] == "adequate"
    assert set(fitted["text"][:1] + fitted["text"][-1:]) == {"noise misjudged"}

    chosen = 0.01 * drawn["design-random"]["layout"]["shapes"][0]["x0"]
    assert 0.01 * numbers(drawn["design-random"]["data"][0]["x"]).max() < chosen < 1
    price = traces(drawn["design-certificate"])
    assert numbers(price["taken"]["y"]).min() > 0.95
    curve = drawn["design-curve"]["data"][0]
    assert np.all(np.diff(numbers(curve["y"])) < 0)
