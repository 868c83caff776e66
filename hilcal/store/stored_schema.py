"""What the documents in a campaign file hold, as far as the program reads it.

Each is checked where it comes out of the file. Keys beside those named here are kept.
"""

from collections.abc import Mapping
from functools import partial
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, Strict, ValidationError

from hilcal.toml import Number

Text = Annotated[str, Strict()]
Count = Annotated[int, Strict(), Field(ge=0)]
Axes = tuple[Number, Number, Number]
Matrix = Annotated[list[tuple[float, ...]], Field(min_length=1)]


class _Document(BaseModel):
    """A document: finite numbers, further keys allowed."""

    model_config = ConfigDict(extra="allow", allow_inf_nan=False)


class _Errors(_Document):
    mean_m: Number
    rms_m: Number
    max_m: Number
    rms_sigma: Number


class _Error(_Document):
    fit: _Errors
    holdout: _Errors


class _Parameter(_Document):
    name: Text
    unit: Text
    value: Number | None
    std: Number | None
    identifiable: bool


class _Identified(_Document):
    n_readings: Count
    variance_factor: Number
    error: _Error
    parameters: list[_Parameter]


class _Diagnosed(_Document):
    verdict: Text
    rejected: list[Text] = []


class _Result(_Document):
    identify: _Identified
    diagnose: _Diagnosed | None = None


class _Options(_Document):
    readings: Literal["deflection", "absolute"]
    scaling: Literal["none", "gu", "gc"]
    effects: dict[str, dict[str, Any]]
    effects_from: dict[str, dict[str, str]] = {}
    cell: dict[str, dict[str, Any]] = {}


class Revision(_Document):
    """A revision, see `store.revision`."""

    effects: list[Text]
    added: Text | None
    removed: Text | None = None
    parent: Annotated[int, Strict()] | None = None
    data_hash: Text
    program_version: Text
    created: Text = ""
    options: _Options
    parameters_json: dict[str, Any]
    result_json: _Result


class Detail(_Document):
    """What is kept with a reading."""

    epoch_wall_s: Number | None = None
    q_actual: tuple[Number, ...] | None = None
    tracker_covariance: Matrix | None = None


class _Doubtful(Detail):
    """A reading that was measured and cannot be of its target under its load."""

    pose: Text
    load: Text
    target: Text | None = None


class _Happened(_Document):
    kind: Text
    utc: Text


class _Answer(_Document):
    device: Text
    driver: Text
    name: Text
    facts: dict[str, Text]


class _Devices(_Happened):
    answers: list[_Answer]


class _Force(_Document):
    wrench: tuple[Number, Number, Number, Number, Number, Number]


class _Tare(_Happened):
    force: _Force


class _Drift(_Happened):
    shift_m: Axes
    sigma: Number
    over: bool


class _Tool(_Happened):
    mass_kg: Number
    com_m: Axes


class _Repeatability(_Happened):
    dof: Count
    poses: Count
    scatter: Number
    instrument: Number
    joint_std: Number


class _Load(_Happened):
    hanging: Text | None  # None while that is being put right
    why: Text = ""


class _Doubted(_Happened):
    why: Text
    reading: _Doubtful
    stored: bool = False  # among the readings: it was seen too late to be doubtful


class _Start(_Happened):
    missing: Count


class _Finished(_Happened):
    readings: Count


class _Noise(_Happened):
    factors: dict[Text, Number] | None  # None where the covariances stay as measured
    along_m: Number = 0.0
    across_m: Number = 0.0
    orientation_rad: Number | None = None
    distance_m: Number = 0.0
    joint_std_rad: Number | None = None


EVENTS: Mapping[str, type[_Happened]] = {
    "devices": _Devices,
    "tare": _Tare,
    "drift": _Drift,
    "tool": _Tool,
    "repeatability": _Repeatability,
    "load": _Load,
    "doubted": _Doubted,
    "start": _Start,
    "finished": _Finished,
    "noise": _Noise,
}


class _Settings(_Document):
    poses: Count
    validation: Count
    max_time_s: Number
    goal_m: Number | None
    limit_m: Number | None
    seed: Annotated[int, Strict()]
    readings: Literal["deflection", "absolute"]
    hide: Text | None
    prior: Text | None = None
    under_load: bool = False

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class _Begun(_Happened):
    settings: _Settings


class _Refined(_Happened):
    readings_sha256: Text
    revisions: Annotated[list[Count], Field(min_length=1)]


class _Decided(_Happened):
    action: Text


class _Frozen(_Happened):
    readings_sha256: Text


ENTRIES: Mapping[str, type[_Happened]] = {
    "begun": _Begun,
    "refined": _Refined,
    "decided": _Decided,
    "frozen": _Frozen,
}


def check(schema: type[BaseModel], content: object) -> None:
    """Refuse a document that is not as it should be.

    Raises:
        ValueError: says where, in a line.
    """
    try:
        schema.model_validate(content)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part)[:40] for part in first["loc"]) or "it"
        raise ValueError(f"{where}: {first['msg']}") from None


def check_event(content: object, known: Mapping[str, type[_Happened]] = EVENTS) -> None:
    """Refuse what is no event of a session, or no entry of a log; raises as `check` does."""
    kind = content.get("kind") if isinstance(content, dict) else None
    check(known.get(kind, _Happened) if isinstance(kind, str) else _Happened, content)


check_entry = partial(check_event, known=ENTRIES)
