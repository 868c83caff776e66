"""LAPACK's routines for triangular factors, called outside of Python's lock.

`scipy.linalg` keeps the lock while LAPACK computes, so that threads wait for each other (measured:
two threads that factorise took as long as one after the other). These are the same routines of the
same library, by the pointers that scipy gives to compiled code: the same bits, in threads.

Matrices are column-major (Fortran order) of double precision, and are overwritten where that is
said. Only the named triangle is read.

Source: *LAPACK Users' Guide*, third edition, SIAM 1999.
"""

import ctypes
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import scipy.linalg.cython_lapack as pointers

from hilcal.types import Floats


@cache
def _routine(name: str, arguments: int) -> Callable[..., None]:
    """Return a routine of LAPACK, all of whose arguments are passed by address."""
    capsule = vars(pointers)["__pyx_capi__"][name]
    api = ctypes.pythonapi
    name_of = ctypes.PYFUNCTYPE(ctypes.c_char_p, ctypes.py_object)(("PyCapsule_GetName", api))
    pointer_of = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.py_object, ctypes.c_char_p)(
        ("PyCapsule_GetPointer", api)
    )
    pointer = pointer_of(capsule, name_of(capsule))
    if not pointer:
        raise ImportError(f"scipy has no pointer to {name}")
    return ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * arguments)(pointer)


def _call(name: str, *arguments: bytes | int | Floats) -> int:
    """Call a routine with its arguments but the last, INFO, which is returned."""
    held: list[Any] = []
    for given in arguments:
        if isinstance(given, bytes):
            held.append(ctypes.c_char_p(given))
        elif isinstance(given, np.ndarray):
            held.append(ctypes.c_void_p(_address(given)))
        else:
            held.append(ctypes.pointer(ctypes.c_int(given)))
    info = ctypes.c_int(0)
    held.append(ctypes.pointer(info))
    _routine(name, len(held))(*held)
    if info.value < 0:
        raise ValueError(f"{name}: argument {-info.value} is not valid")
    return info.value


def _address(a: Floats) -> int:
    """Return where a matrix begins.

    Raises:
        ValueError: for a matrix that is not column-major, or not of double precision.
    """
    if not (a.flags.f_contiguous and a.dtype == np.float64):
        raise ValueError("LAPACK needs column-major matrices of double precision")
    return int(a.ctypes.data)


def factorise(a: Floats, lower: bool = True) -> bool:
    """Overwrite A (K, K) by Cholesky's factor; whether A is positive definite.

    A = L Lᵀ, lower, or Uᵀ U, of which one triangle is read. The other one is set to zero, but where
    A is not positive definite.
    """
    size = len(a)
    if _call("dpotrf", _triangle(lower), size, a, max(size, 1)):
        return False
    if size > 1:  # from the element beside the diagonal on, a matrix that is smaller by one
        clear = _routine("dlaset", 7)
        inner, zero = ctypes.byref(ctypes.c_int(size - 1)), ctypes.byref(ctypes.c_double(0.0))
        first = ctypes.c_void_p(_address(a) + a.itemsize * (size if lower else 1))
        rest = ctypes.c_char_p(_triangle(not lower))
        clear(rest, inner, inner, zero, zero, first, ctypes.byref(ctypes.c_int(size)))
    return True


def invert(t: Floats, lower: bool = True) -> None:
    """Overwrite a triangle T (K, K) by its inverse; the other triangle stays as it is.

    Raises:
        LinAlgError: the diagonal has a zero.
    """
    if _call("dtrtri", _triangle(lower), b"N", len(t), t, max(len(t), 1)):
        raise np.linalg.LinAlgError("a triangle with a zero in its diagonal has no inverse")


def solve_factored(low: Floats, rhs: Floats) -> None:
    """Overwrite the right-hand sides B (K, N) or (K,) by (L Lᵀ)⁻¹ B."""
    count = 1 if rhs.ndim == 1 else rhs.shape[1]
    _call("dpotrs", b"L", len(low), count, low, max(len(low), 1), rhs, max(len(rhs), 1))


def solve_triangle(low: Floats, rhs: Floats, transposed: bool = False) -> None:
    """Overwrite the right-hand sides B (K, N) or (K,) by L⁻¹ B, or L⁻ᵀ B.

    Raises:
        LinAlgError: the diagonal has a zero.
    """
    count = 1 if rhs.ndim == 1 else rhs.shape[1]
    form = (b"L", b"T" if transposed else b"N", b"N")
    size = max(len(low), 1)
    if _call("dtrtrs", *form, len(low), count, low, size, rhs, max(len(rhs), 1)):
        raise np.linalg.LinAlgError("a triangle with a zero in its diagonal has no inverse")


def column_major(a: Floats) -> Floats:
    """Return a copy of a matrix or vector for these routines."""
    return np.array(a, dtype=float, order="F")


def _triangle(lower: bool) -> bytes:
    return b"L" if lower else b"U"
