"""A stream of readings against reading the same chunks and multiplying them, in one run.

Two ratios of rates, both of processor time. "Rows given": a Parquet file has the whitened rows
themselves, which are read and reduced to a triangle, against read and multiplied (one product AᵀA).
"The whole": a file has joints and positions; each pass reads, predicts, whitens and reduces them,
against the same with AᵀA, and against the reading and multiplying of given rows alone.
"""

import resource
import time

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from hilcal import stream as passes
from hilcal.identification.carried.carried_prior import scales_of
from hilcal.model.model import Model
from hilcal.regression.normal_equations import Triangle
from hilcal.tables.parquet_stream import open_stream
from tests.benchmarks.test_cost import EFFECTS
from tests.support.stream_cases import cell, write

pytestmark = pytest.mark.slow

READINGS = 200_000
PARAMETERS = 30
CHUNK = 8192
ROUNDS = 3
LEAST = 0.6  # rate over that with AᵀA
LIMIT = f"{LEAST} or more"


class Product:
    """AᵀA of rows as they come, in place of a triangle."""

    def __init__(self, size):
        self.r = np.zeros((size, size))

    def add(self, rows, right=None):
        count = rows.shape[1]
        self.r[:count, :count] += rows.T @ rows
        if right is not None:
            self.r[:count, count] += right @ rows
            self.r[count, count] += right @ right


def rows_file(path):
    """Whitened rows and right-hand side of `READINGS` 3-D readings, a column each."""
    rng = np.random.default_rng(0)
    names = [f"a{k}" for k in range(PARAMETERS + 1)]
    schema = pa.schema([(name, pa.float64()) for name in names])
    with pq.ParquetWriter(path, schema, compression="none", use_dictionary=False) as out:
        for _ in range(3 * READINGS // (3 * CHUNK)):
            part = [pa.array(rng.normal(size=3 * CHUNK)) for _ in names]
            out.write_table(pa.table(part, schema=schema))


def given_rows(path, kind):
    total = kind(PARAMETERS + 1)
    for batch in pq.ParquetFile(path).iter_batches(CHUNK):
        total.add(np.stack([c.to_numpy() for c in batch.columns]).T)
    return total.r


def the_whole(work, theta):
    return [passes.reduce_group(k, work, theta) for k in range(len(work.stream.rows))]


def seconds(work):
    begun = time.process_time()
    work()
    return time.process_time() - begun


def work_of(stream):
    of = cell()
    states = next(stream.chunks(0)).states
    effects = tuple(effect(of, states) for effect in EFFECTS)
    model = Model(of, effects)
    assert model.size == PARAMETERS
    return passes.PassTask(stream, model, np.zeros(6), {}), 1e-3 * scales_of(model)


def test_a_stream_against_reading_and_multiplying(benchmark, claim, tmp_path, monkeypatch):
    rows, path = tmp_path / "rows.parquet", tmp_path / "moving.parquet"
    rows_file(rows)
    write(path, READINGS, group=100_000)
    work, theta = work_of(open_stream(path, cell().arm, None, None))
    times = {}
    for _ in range(ROUNDS):
        times.setdefault("multiply", []).append(seconds(lambda: given_rows(rows, Product)))
        times.setdefault("reduce", []).append(seconds(lambda: given_rows(rows, Triangle)))
        times.setdefault("whole", []).append(seconds(lambda: the_whole(work, theta)))
        with monkeypatch.context() as patch:
            patch.setattr(passes, "Triangle", Product)
            times.setdefault("whole multiply", []).append(seconds(lambda: the_whole(work, theta)))
    best = {name: min(value) for name, value in times.items()}
    given = best["multiply"] / best["reduce"]
    size = f"{READINGS} 3-D readings x {PARAMETERS} parameters"
    claim(f"stream, rows given, {size}: rate over reading and AᵀA", f"{given:.2f}", LIMIT)
    same = best["whole multiply"] / best["whole"]
    claim(f"stream, a whole pass, {size}: rate over the same with AᵀA", f"{same:.2f}", LIMIT)
    alone = best["multiply"] / best["whole"]
    claim(f"stream, a whole pass, {size}: over reading given rows and AᵀA", f"{alone:.3f}", "noted")
    claim("stream, a whole pass: readings a second", f"{READINGS / best['whole']:.0f}", "noted")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    claim("resident memory of the benchmarks so far, GB", f"{peak:.2f}", "1 of a stream alone")
    benchmark.extra_info.update(best)
    benchmark.pedantic(given_rows, args=(rows, Triangle), rounds=1)
    assert min(given, same) >= LEAST
