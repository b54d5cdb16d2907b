"""Rows of a model."""

import numpy as np
import pytest

from builders import random_splats

ROWS = {
    "indices": np.array([5, 0, 0, 11, -1]),
    "int32": np.array([3, 1], np.int32),
    "none": np.empty(0, np.int64),
    "mask": np.arange(12) % 3 == 0,
    "slice": slice(2, 9, 3),
}


@pytest.mark.parametrize("rows", ROWS.values(), ids=ROWS)
def test_every_column_is_taken_with_its_row(rows):
    labels = np.arange(12, dtype=">u2")
    splats = random_splats(12, extras={"label": labels})
    some = splats.take(rows)
    for name in ("means", "log_scales", "quats", "opacity_logits", "sh"):
        column = getattr(splats, name)
        np.testing.assert_array_equal(getattr(some, name), column[rows])
        assert getattr(some, name).dtype == column.dtype
    np.testing.assert_array_equal(some.extras["label"], labels[rows])
    assert some.extras["label"].dtype == labels.dtype


def test_a_row_that_is_not_there_is_refused():
    with pytest.raises(IndexError):
        random_splats(12).take(np.array([12]))
