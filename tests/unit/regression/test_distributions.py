"""Our thin distributions against those of scipy.stats."""

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from hilcal.regression import distributions

DOF = st.floats(0.5, 1e4)
VALUE = st.floats(-1.0, 1e4)
CHANCE = st.floats(1e-12, 1 - 1e-12)


@given(VALUE, DOF, CHANCE)
def test_chi2(x: float, df: float, p: float) -> None:
    for name in ("sf", "cdf"):
        ours, theirs = getattr(distributions.chi2, name), getattr(stats.chi2, name)
        assert ours(x, df) == pytest.approx(theirs(x, df), rel=1e-9, abs=1e-300)
    for name in ("ppf", "isf"):
        ours, theirs = getattr(distributions.chi2, name), getattr(stats.chi2, name)
        assert ours(p, df) == pytest.approx(theirs(p, df), rel=1e-9)
    assert distributions.chi2.median(df) == pytest.approx(stats.chi2.median(df), rel=1e-9)


@given(VALUE, DOF, DOF)
def test_tail_of_f(x: float, dfn: float, dfd: float) -> None:
    theirs = stats.f.sf(x, dfn, dfd)
    assert distributions.f.sf(x, dfn, dfd) == pytest.approx(theirs, rel=1e-9, abs=1e-300)


@given(st.floats(1e-9, 0.999), st.integers(1, 300), st.integers(1, 3000))
def test_quantile_of_f_has_its_tail(p: float, dfn: int, dfd: int) -> None:
    assert stats.f.sf(distributions.f.isf(p, dfn, dfd), dfn, dfd) == pytest.approx(p, rel=1e-7)


@given(st.floats(1e-6, 1e3), st.integers(1, 300), st.integers(1, 3000), st.floats(1e-9, 0.5))
def test_power_is_a_tail_of_the_noncentral(nc: float, dfn: int, dfd: int, p: float) -> None:
    x = float(distributions.chi2.isf(p, dfn))
    assert distributions.ncx2.sf(x, dfn, nc) == pytest.approx(stats.ncx2.sf(x, dfn, nc), rel=1e-9)
    x = float(distributions.f.isf(p, dfn, dfd))
    theirs = stats.ncf.sf(x, dfn, dfd, nc)
    assert distributions.ncf.sf(x, dfn, dfd, nc) == pytest.approx(theirs, rel=1e-9)


@given(st.floats(0.0, 1.0), st.sampled_from([0.5, 1.0, 2.5]))
def test_beta(x: float, a: float) -> None:
    assert distributions.beta.cdf(x, a, 0.5) == pytest.approx(stats.beta.cdf(x, a, 0.5), rel=1e-12)


def test_a_noncentrality_of_nothing_or_very_much() -> None:
    for nc, chance in ((0.0, 0.01), (1e7, 1.0)):
        assert distributions.ncx2.sf(stats.chi2.isf(0.01, 6), 6, nc) == pytest.approx(chance)
        assert distributions.ncf.sf(stats.f.isf(0.01, 6, 50), 6, 50, nc) == pytest.approx(chance)


@given(st.floats(-30.0, 30.0), CHANCE, st.floats(1e-3, 1e3))
def test_normal(x: float, p: float, scale: float) -> None:
    norm = distributions.norm
    assert norm.sf(x) == pytest.approx(stats.norm.sf(x), rel=1e-12)
    assert norm.logsf(x) == pytest.approx(stats.norm.logsf(x), rel=1e-12)
    assert norm.ppf(p) == pytest.approx(stats.norm.ppf(p), rel=1e-9, abs=1e-12)
    assert norm.isf(p) == pytest.approx(stats.norm.isf(p), rel=1e-9, abs=1e-12)
    assert norm.pdf(x, scale) == pytest.approx(stats.norm.pdf(x, scale=scale), rel=1e-9, abs=1e-300)


@given(CHANCE, st.floats(1.0, 1e4), st.floats(-50.0, 50.0))
def test_t(p: float, df: float, x: float) -> None:
    assert distributions.t.sf(x, df) == pytest.approx(stats.t.sf(x, df), rel=1e-9)
    assert distributions.t.ppf(p, df) == pytest.approx(stats.t.ppf(p, df), rel=1e-6, abs=1e-9)


@given(st.integers(-2, 60), st.integers(1, 50), st.floats(0.0, 1.0))
def test_binomial(k: int, n: int, p: float) -> None:
    theirs = stats.binom.sf(k, n, p)
    assert distributions.binom.sf(k, n, p) == pytest.approx(theirs, rel=1e-9, abs=1e-14)


@pytest.mark.parametrize(("x", "df"), [(5.0, 0), (0.0, 0), (5.0, -1.0), (np.inf, 3), (np.nan, 3)])
def test_edges_are_those_of_scipy(x: float, df: float) -> None:
    np.testing.assert_array_equal(distributions.chi2.sf(x, df), stats.chi2.sf(x, df))
    np.testing.assert_array_equal(distributions.f.sf(x, df, 3), stats.f.sf(x, df, 3))


def test_arrays_broadcast_and_scalars_stay_scalars() -> None:
    x = np.linspace(0.0, 9.0, 5)
    np.testing.assert_allclose(
        distributions.chi2.sf(x[:, None], [1, 2, 3]), stats.chi2.sf(x[:, None], [1, 2, 3])
    )
    assert np.ndim(distributions.chi2.sf(1.0, 2)) == 0


def test_a_command_starts_without_scipy_stats() -> None:
    code = (
        "import sys, contextlib, io; from hilcal.cli import main\n"
        "with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):\n"
        "    main(['effects'])\n"
        "sys.exit('scipy.stats' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
