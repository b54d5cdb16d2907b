"""Arrays: conversion of arguments (lists, other number types, tensors), and tests of rows."""

import os
from typing import Any

import numpy as np

from nanogs._types import I32, I64, Array, Bool, F
from nanogs.errors import ModelError


def as_array(name: str, value: object) -> Array:
    """Convert a value to an array; tensors are detached and copied to the CPU.

    Args:
        name: Name of the value, for the message.
        value: An array, nested lists, or a tensor of PyTorch, JAX and the like. Of an array of a
            subclass, such as a memory map, a plain view is returned.

    Raises:
        ModelError: It is a path, entries are masked, or NumPy cannot convert it.
    """
    if isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value):
        raise ModelError(
            f"{name} has masked entries; fill them, or leave out the rows that have them."
        )
    if isinstance(value, np.ndarray):
        return np.asarray(value)
    if isinstance(value, str | os.PathLike):
        path = os.fspath(value)
        raise ModelError(f"{name} is the path {path!r}, not an array; nanogs.load reads files.")
    try:
        for step in ("detach", "cpu"):  # methods of PyTorch's tensors; PyTorch is not imported
            if callable(method := getattr(value, step, None)):
                value = method()
        return np.asarray(value)
    except (TypeError, ValueError, RuntimeError) as error:
        reason = str(error).splitlines()[0].rstrip(".") if str(error) else type(error).__name__
        raise ModelError(
            f"{name} cannot be converted to an array ({reason}); convert it first."
        ) from None


def as_floats(name: str, value: object, *, double: bool = False) -> F:
    """Convert to float32; an array that needs no conversion is returned itself.

    Args:
        name: Name of the value, for the message.
        value: See `as_array`.
        double: Keep float64 arrays as float64.

    Raises:
        ModelError: It is no array of real numbers, or a number is too large for float32.
    """
    array = as_array(name, value)
    if array.dtype == np.float32 or (double and array.dtype == np.float64 and _typed(value)):
        return array
    if array.dtype.kind not in "fiu":
        raise ModelError(f"{name} must hold real numbers, not {array.dtype}.")
    with np.errstate(over="raise"):
        try:
            return array.astype(np.float32)
        except FloatingPointError:
            raise ModelError(f"{name} holds numbers that are too large for float32.") from None


def _typed(value: object) -> bool:
    """Return whether the value has a dtype of its own; numbers in lists always become float64."""
    return hasattr(value, "dtype")


def as_rows(rows: Any, count: int) -> I64 | I32 | Bool | slice:  # noqa: ANN401 - it is found out here
    """Convert an index of rows to a slice, a mask or an array of row numbers.

    Args:
        rows: A number, a slice, a mask of `count` flags, or row numbers; negative ones count from
            the end.
        count: Number of rows of the model.

    Raises:
        IndexError: It is none of these, the mask has another length, or there is no such row.
    """
    if isinstance(rows, slice):
        return rows
    if not isinstance(rows, bool | tuple) and hasattr(rows, "__index__") and np.ndim(rows) == 0:
        row = int(rows)
        if not -count <= row < count:
            raise IndexError(f"There is no splat {row} among {count:,}.")
        return slice(row % count, row % count + 1)
    array = np.empty(0, np.int64) if isinstance(rows, list) and not rows else _index_array(rows)
    if array.ndim != 1 or array.dtype.kind not in "biu":
        raise _no_rows(rows)
    if array.dtype == bool and len(array) != count:
        raise IndexError(
            f"A mask must have one flag for each of the {count:,} splats, not {len(array)}."
        )
    # NumPy's `take` refuses uint64. Signed types are kept: int64 could take twice the memory.
    return array.astype(np.int64) if array.dtype.kind == "u" else array


def _index_array(rows: object) -> Array:
    if isinstance(rows, tuple):
        raise _no_rows(rows)
    try:
        return as_array("the index", rows)
    except ModelError:
        raise _no_rows(rows) from None


def _no_rows(rows: object) -> IndexError:
    given = type(rows).__name__
    if isinstance(rows, np.ndarray):
        given = f"{rows.dtype} of shape {rows.shape}"
    return IndexError(
        f"Splats are indexed by a number, a slice, a mask or an array of row numbers, not {given}."
    )


def each_row(flags: Bool) -> Bool:
    """Return the (N,) bool mask of the rows of (N, ...) flags that are all true.

    It is fast if all flags are true: reducing row by row takes ten times as long.
    """
    if flags.all():
        return np.ones(len(flags), bool)
    return np.asarray(flags.reshape(len(flags), -1).all(axis=1))
