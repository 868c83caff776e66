"""The error of every revision: one mark each, on a logarithmic axis; the present one framed."""

import numpy as np
import rerun as rr

from hilcal.present.story import StoryRevision
from hilcal.present.viewer import style
from hilcal.present.viewer.digest import Digest
from hilcal.present.viewer.flat import BELOW, FOOT, HEIGHT, RAISED, TITLE, Frame, ticks, write
from hilcal.types import Floats

ORIGIN = "errors"
WIDTH = 640.0  # of this picture: its place in the window is wide and low
BOUNDS = (TITLE - 8.0, BELOW + 3.0)
SERIES = (
    ("fit", "fitted poses, rms", style.MEASURED),
    ("holdout", "poses left out, rms", style.HOLDOUT),
    ("largest", "largest of all", style.RED),
)
NOISE = "noise alone, rms"
_APART = 3.5  # between marks of one revision, so that equal errors stay visible
_MOST_NUMBERS = 20
_STEPS = (1.0, 2.0, 5.0)
_ROOM = 1.4  # factor that the axis reaches beyond the smallest and the largest error
_LEAST = 1e-6  # of the largest error; a smaller one is drawn here: an error can be 0


def error_values(d: Digest) -> dict[str, Floats]:
    """Return the (R,) errors of each series, µm."""
    told = {
        "fit": [r.error_fit["rms_m"] for r in d.story.revisions],
        "holdout": [r.error_holdout["rms_m"] for r in d.story.revisions],
        "largest": [r.error_fit["max_m"] for r in d.story.revisions],
    }
    return {name: 1e6 * np.array(values) for name, values in told.items()}


def axis(d: Digest) -> Frame:
    """Return the ranges: the number of the revision from 0, and the logarithm of the error in µm.

    Every error of every revision is inside.
    """
    found = np.concatenate([*error_values(d).values(), [1e6 * d.story.noise_floor_m]])
    top = float(found.max()) or 1.0
    low = max(float(found.min()), _LEAST * top)
    ends = np.log10([low / _ROOM, top * _ROOM])
    return Frame((-0.5, len(d.story.revisions) - 0.5), (float(ends[0]), float(ends[1])), WIDTH)


def height(values: Floats) -> Floats:
    """Return the logarithms of errors in µm, as `axis` has them."""
    return np.asarray(np.log10(np.maximum(values, 1e-300)))


def decades(low: float, high: float) -> Floats:
    """Return round numbers between two: 1, 2 and 5 of each decade, or 1 alone where many."""
    powers = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
    for steps in (_STEPS, _STEPS[:1]):
        found = np.sort(np.outer(powers, steps).reshape(-1))
        found = found[(found >= low) & (found <= high)]
        if len(found) <= 5:
            break
    return found if len(found) >= 2 else ticks(low, high, most=3)


def error_picture(rec: rr.RecordingStream, d: Digest, static: bool = True) -> None:
    """Log, for all times, the errors of all revisions: marks only, nothing is between them.

    Without `static` for the recording's current time.
    """
    frame = axis(d)
    low = frame.y[0]
    for k, (name, _, color) in enumerate(SERIES):
        values = np.maximum(height(error_values(d)[name]), low)
        at = frame.place(np.arange(len(values), dtype=float), values)
        at[:, 0] += (k - 1) * _APART
        rec.log(
            f"{ORIGIN}/{name}",
            rr.Points2D(at, colors=[color], radii=rr.Radius.ui_points(4.0), draw_order=50.0),
            static=static,
        )
    floor = np.maximum(height(np.full(2, 1e6 * d.story.noise_floor_m)), low)
    rec.log(
        f"{ORIGIN}/noise",
        rr.LineStrips2D(
            [frame.place(np.array(frame.x), floor)],
            colors=[style.NOISE],
            radii=rr.Radius.ui_points(1.2),
        ),
        static=static,
    )
    levels = decades(10.0 ** frame.y[0], 10.0 ** frame.y[1])
    rec.log(f"{ORIGIN}/axes", frame.lines(np.zeros(0), np.log10(levels)), static=static)
    up = frame.place(np.zeros(len(levels)), np.log10(levels))[:, 1]
    places = [(-9.0, float(y) + RAISED) for y in up]
    write(rec, f"{ORIGIN}/ticks", places, [f"{v:.6g}" for v in levels], static=static)


def error_now(rec: rr.RecordingStream, d: Digest, r: StoryRevision) -> None:
    """Log a frame about one revision and what it changed, and its errors in words.

    Above the words are lines in the colours of the marks.
    """
    k = [o.revision for o in d.story.revisions].index(r.revision)
    frame = axis(d)
    left, right = (float(x) for x in frame.place(np.array([k - 0.4, k + 0.4]), np.zeros(2))[:, 0])
    box = [(left, 0.0), (right, 0.0), (right, HEIGHT), (left, HEIGHT), (left, 0.0)]
    rec.log(
        f"{ORIGIN}/now",
        rr.LineStrips2D([box], colors=[style.LEADER], radii=rr.Radius.ui_points(0.8)),
    )
    told = {name: float(values[k]) for name, values in error_values(d).items()}
    texts = [f"{meaning} {_length(told[name])}" for name, meaning, _ in SERIES]
    texts.append(f"{NOISE} {_length(1e6 * d.story.noise_floor_m)}")
    colors = [color for *_, color in SERIES] + [style.NOISE]
    places = [((i + 0.5) * WIDTH / len(texts), TITLE - 5.0) for i in range(len(texts))]
    numbers = [o.revision for o in d.story.revisions]
    shown = [i for i in range(0, len(numbers), -(-len(numbers) // _MOST_NUMBERS)) if i != k] + [k]
    at = frame.place(np.array(shown, dtype=float), np.zeros(len(shown)))[:, 0]
    names = [f"{numbers[i]}" for i in shown[:-1]] + [f"{r.revision}: {r.change or 'first model'}"]
    foot = [(float(x), FOOT) for x in at]
    write(rec, f"{ORIGIN}/words", [*places, *foot], [*texts, *names])
    reach = 0.4 * WIDTH / len(texts)
    keys = [[(x - reach, TITLE - 5.0), (x + reach, TITLE - 5.0)] for x, _ in places]
    rec.log(
        f"{ORIGIN}/keys",
        rr.LineStrips2D(keys, colors=colors, radii=rr.Radius.ui_points(2.0)),
    )


def _length(micrometres: float) -> str:
    return style.micrometres(1e-6 * micrometres)
