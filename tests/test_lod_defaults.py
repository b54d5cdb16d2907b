"""The levels that are made by default."""

import numpy as np
import pytest

import nanogs
from builders import random_splats
from nanogs.errors import OptionError
from nanogs.lod.usual import PHONE, default_ratios


@pytest.mark.parametrize(
    ("splats", "halves"),
    [(1, 3), (500_000, 3), (8 * PHONE, 3), (8 * PHONE + 1, 4), (10**8, 7), (10**15, 16)],
)
def test_default_levels_halve_down_to_what_a_phone_draws(splats, halves):
    assert default_ratios(splats) == tuple(0.5**half for half in range(halves + 1))
    assert default_ratios(splats, tree=True)[-1] == 0.5 ** max(halves, 6)


def test_a_model_without_splats_has_no_levels():
    with pytest.raises(OptionError, match="without splats"):
        default_ratios(0)


@pytest.mark.parametrize("max_memory", [None, "600MB"])
def test_the_finest_level_has_the_splats_of_the_input(tmp_path, max_memory):
    model = random_splats(3000, degree=1)
    nanogs.save(model, tmp_path / "a.ply")
    options = {"preset": "fast", "max_memory": max_memory}
    if max_memory:
        options["block"] = 1000
    manifest, _ = nanogs.write_levels(tmp_path / "a.ply", tmp_path / "levels", **options)
    assert [level.count for level in manifest.levels] == [3000, 1500, 750, 375]
    finest = nanogs.load(tmp_path / "levels" / "level_0.ply")
    order, rows = (np.lexsort(each.means.T) for each in (finest, model))
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        assert np.array_equal(getattr(finest, name)[order], getattr(model, name)[rows])
    if max_memory is None:  # in blocks, splats are in the order of the blocks
        ours = (tmp_path / "levels" / "level_0.ply").read_bytes()
        assert ours == (tmp_path / "a.ply").read_bytes()
