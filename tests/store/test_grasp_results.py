"""Grasp sets in a session: measures are kept, files of the first format are still read."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from bop_scenes import edit
from realsim import store as stores
from refusals import refused
from tried_grasps import assert_same, tried_set


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=15, deadline=None)
def test_sets_with_measures_come_back_bit_for_bit(tmp_path_factory, seed):
    folder = tmp_path_factory.mktemp("g")
    s = tried_set(np.random.default_rng(seed), 12)
    stores.save_grasps(folder, s)
    assert_same(s, stores.load_grasps(folder)[0])


def test_files_of_the_first_format_are_still_read(tmp_path):
    s = tried_set(np.random.default_rng(1), 12, measures=())
    note = stores.save_grasps(tmp_path, s).with_suffix(".json")
    edit(note, lambda head: head.update(format_version=1))
    edit(note, lambda head: head.pop("measures"))
    assert_same(s, stores.load_grasps(tmp_path)[0])


def test_a_newer_format_is_refused_by_its_number(tmp_path):
    path = stores.save_grasps(tmp_path, tried_set(np.random.default_rng(1), 3))
    for found in (3, 0, "2", None):
        edit(path.with_suffix(".json"), lambda head, v=found: head.update(format_version=v))
        refused(r"format.version", stores.load_grasps, tmp_path)
