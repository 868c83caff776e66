"""The recording of a fleet: which arm is unlike its type, in which joint, and since when."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from hilcal import numbers
from hilcal.present.document import heading
from hilcal.present.fleet import type_report
from hilcal.present.viewer import fleet_scene, layout
from hilcal.present.viewer.fleet_scene import TypeDigest, type_digest
from hilcal.present.viewer.markdown import document, markdown
from hilcal.present.viewer.stream import flush, opened, require_folder, write

if TYPE_CHECKING:  # above this layer
    from hilcal.transfer.fleet import Fleet

_LEAST_RANGE_S = 86400.0
GUIDE = """### How to read this
- **Arms**: one of each, side by side. A red joint is unlike the others of the type; its arm stands
  in a red frame. Amber: beyond 3 σ, which chance does to one parameter in some hundred.
- **By date**: each campaign in σ of the type: the spread from arm to arm together with the
  uncertainty of the campaign. A line that leaves the others has changed; lines that go
  the same way are wear.
"""


def record_fleet(fleet: "Fleet", path: Path) -> None:
    """Write what is known of a fleet as a recording file; equal fleets give equal recordings.

    Raises:
        InputError: the folder is missing.
        HilcalError: the file cannot be written.
    """
    path = Path(path)
    require_folder(path)
    types = [type_digest(t, fleet.members) for t in fleet.types]
    told = [(d.pooled.type, d.pooled.arms, d.pooled.odd, d.names) for d in types]
    rec = opened(told, *(a for d in types for a in (d.units, d.seconds, d.campaigns)))
    write(rec, _blueprint(types), lambda: _log(rec, types), path)


def _log(rec: rr.RecordingStream, types: list[TypeDigest]) -> None:
    arms = sum(len(d.pooled.arms) for d in types)
    rec.send_recording_name(f"hilcal fleet: {arms} arms")
    for i, d in enumerate(types):
        fleet_scene.arms(rec, f"arms{i}", d)
        fleet_scene.drift(rec, f"date{i}", d)
        rec.log(f"words/type{i}", document(_told(d)), static=True)
    rec.log("words/guide", document(GUIDE), static=True)
    flush(rec)


def _told(d: TypeDigest) -> str:
    odd = list(dict.fromkeys(o.arm for o in d.pooled.odd))
    verb = "is" if len(odd) == 1 else "are"
    title = f"{numbers.names(odd)} {verb} unlike the others" if odd else "No arm is unlike"
    name, table, note, *lines = type_report(d.pooled)
    return markdown([heading(title), name, *lines, table, note])


def _blueprint(types: list[TypeDigest]) -> rrb.Blueprint:
    """Left: the arms over their campaigns by date. Right: the verdict and the parameters."""
    many = len(types) > 1
    of = [f"{d.pooled.type}: " if many else "" for d in types]
    arms = [_arms(f"arms{i}", of[i], d) for i, d in enumerate(types)]
    dates = [
        rrb.TimeSeriesView(
            origin=f"date{i}/{k}",
            name=f"{of[i]}{d.names[k]} by date [σ]",
            plot_legend=rrb.PlotLegend(visible=False),
            axis_x=_whole(d),
        )
        for i, d in enumerate(types)
        for k in sorted(fleet_scene.rows(d), key=lambda k: (not d.odd[:, k].any(), k))
    ]
    words = [
        rrb.TextDocumentView(origin=f"words/type{i}", name=f"{of[i]}Unlike the type")
        for i in range(len(types))
    ]
    words.append(rrb.TextDocumentView(origin="words/guide", name="How to read this"))
    left = rrb.Vertical(rrb.Tabs(*arms), rrb.Tabs(*dates), row_shares=[3, 2])
    return layout.whole(rrb.Horizontal(left, rrb.Tabs(*words), column_shares=[3, 2]), "date")


def _whole(d: TypeDigest) -> rrb.TimeAxis:
    """Return the range of all dates, with a margin."""
    low, high = float(d.seconds.min()), float(d.seconds.max())
    wide = max(0.05 * (high - low), _LEAST_RANGE_S)
    ends = [rrb.TimeRangeBoundary.absolute(seconds=t) for t in (low - wide, high + wide)]
    return rrb.TimeAxis(view_range=rrb.TimeRange(*ends))


def _arms(origin: str, of: str, d: TypeDigest) -> rrb.Spatial3DView:
    at, reach = fleet_scene.places(d), max(d.arm.reach, 0.1)
    middle = at.mean(axis=0) + np.array([0.0, 0.0, 0.35 * reach])
    size = float(np.ptp(at, axis=0).max()) + reach
    name = f"{of}{len(at)} arms; a red frame: unlike the others, the red joint says where"
    return layout.view3d(origin, name, middle + size * np.array([0.68, 0.0, 0.36]), middle)
