"""Blocks chosen by sums over folds are those that columns projected off the model choose."""

import numpy as np

from hilcal.regression.forward_selection import BlockSelection, block_evidence

STRENGTHS = np.logspace(-2, 3, 21)
ROWS, MODEL, BLOCKS, WIDTH, FOLDS = 400, 12, 15, 4, 5


def chosen_by_columns(own, ridge, x, y, most: int, least: float) -> list[int]:
    """Project all columns off the model, and what is left off each block that is chosen."""
    h = np.linalg.inv(own.T @ own + np.diag(ridge))
    m = np.eye(len(y)) - own @ h @ own.T
    blocks, r, dof = np.tensordot(m, x, axes=1), m @ y, max(len(y) - own.shape[1], 1)
    chosen = []
    for _ in range(most):
        gram = np.einsum("rlv,rlw->lvw", blocks, blocks)
        g = np.einsum("rlw,r->lw", blocks, r)
        evidence = block_evidence(gram, g, float(r @ r), dof, STRENGTHS)
        best = int(np.argmax(evidence))
        if evidence[best] < least:
            break
        chosen.append(best)
        u, s, _ = np.linalg.svd(blocks[:, best], full_matrices=False)
        u = u[:, s > 1e-3 * s[0]]
        blocks = blocks - np.tensordot(u, np.tensordot(u.T, blocks, axes=1), axes=1)
        r, dof = r - u @ (u.T @ r), max(dof - u.shape[1], 1)
    return chosen


def test_the_same_blocks_in_the_same_order() -> None:
    lengths = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        own, x = rng.normal(size=(ROWS, MODEL)), rng.normal(size=(ROWS, BLOCKS, WIDTH))
        x[:, 3] = x[:, 2] + 0.1 * x[:, 3]  # nearly the same block
        x[:, 5, 0] = own[:, 1]  # a column of the model
        ridge = np.where(np.arange(MODEL) < 6, 1e-6, 50.0)
        y = x[:, 2] @ rng.normal(size=WIDTH) + x[:, 7, 0] + x[:, 9, 1] + rng.normal(size=ROWS)
        y += own @ rng.normal(size=MODEL)
        fold = rng.integers(0, FOLDS, ROWS)
        selection = BlockSelection(own, ridge, x, y, fold)
        for f in range(FOLDS):
            rest = fold != f
            expected = chosen_by_columns(own[rest], ridge, x[rest], y[rest], 4, 8.0)
            assert selection.without(f, 4, 8.0, STRENGTHS) == expected
            lengths.append(len(expected))
    assert min(lengths) >= 3


def test_nothing_is_chosen_of_noise() -> None:
    rng = np.random.default_rng(1)
    own, x = rng.normal(size=(ROWS, MODEL)), rng.normal(size=(ROWS, BLOCKS, WIDTH))
    y, fold = rng.normal(size=ROWS), np.arange(ROWS) % FOLDS
    selection = BlockSelection(own, np.full(MODEL, 1e-6), x, y, fold)
    assert [selection.without(f, 4, 8.0, STRENGTHS) for f in range(FOLDS)] == [[]] * FOLDS


def test_a_fold_that_the_sample_has_no_row_of_is_left_out_of_nothing() -> None:
    """As one pose read 12,000 times beside others: a sample of the rows misses whole poses."""
    rng = np.random.default_rng(0)
    own, x = rng.normal(size=(60, 2)), rng.normal(size=(60, 3, 2))
    y = x[:, 1, 0] + 0.1 * rng.normal(size=60)
    first = BlockSelection(own, np.ones(2), x, y, np.arange(60) % 3)
    strengths = np.array([0.1, 1.0])
    assert first.without(3, 2, 3.0, strengths) == first.without(7, 2, 3.0, strengths) == [1]
