"""Grasp sets in a session: measures are kept, files of the first format are still read."""

import json

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

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
    path = stores.save_grasps(tmp_path, s)
    note = path.with_suffix(".json")
    head = json.loads(note.read_text())
    head["format_version"] = 1
    del head["measures"]
    note.write_text(json.dumps(head))
    assert_same(s, stores.load_grasps(tmp_path)[0])


def test_a_newer_format_is_refused_by_its_number(tmp_path):
    path = stores.save_grasps(tmp_path, tried_set(np.random.default_rng(1), 3))
    note = path.with_suffix(".json")
    for found in (3, 0, "2", None):
        note.write_text(json.dumps(json.loads(note.read_text()) | {"format_version": found}))
        refused(r"format.version", stores.load_grasps, tmp_path)
