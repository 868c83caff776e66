"""Recordings read back: what is in them, by entity, component and time."""

import subprocess

from rerun.chunk import RrdReader

from hilcal.present.viewer.recording import executable


def chunks(path, entity=""):
    stream = RrdReader(path).stream()
    return iter((stream.filter(content=entity) if entity else stream).to_chunks())


def values(path, entity, component):
    """Every value of a component, row after row."""
    batches = (chunk.to_record_batch() for chunk in chunks(path, entity))
    selected = [batch.column(component) for batch in batches if component in batch.schema.names]
    return [value for column in selected for value in column.to_pylist() if value is not None]


def rows(path, entity, component, timeline="step"):
    """The values of a component by time, under 0 what is static."""
    out = {}
    for chunk in chunks(path, entity):
        batch = chunk.to_record_batch()
        if component not in batch.schema.names:
            continue
        cells = batch.column(component).to_pylist()
        if timeline in batch.schema.names:
            times = batch.column(timeline).to_pylist()
        elif not chunk.timeline_names:
            times = [0] * len(cells)
        else:
            continue
        out |= {int(t): v for t, v in zip(times, cells, strict=True) if v is not None}
    return out


def texts(path):
    """Every string that a viewer would have to draw."""
    kinds = (":text", ":labels", ":names", ":name")
    return [
        text
        for batch in (chunk.to_record_batch() for chunk in chunks(path))
        for name in batch.schema.names
        if name.endswith(kinds)
        for row in batch.column(name).to_pylist()
        for text in row or ()
        if text is not None
    ]


def entities(path):
    return {str(chunk.entity_path) for chunk in chunks(path)}


def same(a, b):
    """Whether two recordings hold the same, as rerun itself compares them."""
    command = [executable(), "rrd", "compare", str(a), str(b)]
    return subprocess.run(command, capture_output=True, check=False).returncode == 0
