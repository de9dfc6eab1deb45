"""Trajectories beside the grasps: the same when read, whole or not there, and of those grasps."""

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from begun_sessions import begun
from realsim import store as stores
from realsim.geometry import se3
from realsim.records import CameraIntrinsics
from realsim.store.trajectories import load_trajectories, save_trajectories
from refusals import refused
from tried_grasps import assert_same, attempts_of, tried_set


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=15, deadline=None)
def test_attempts_come_back_bit_for_bit(tmp_path_factory, seed):
    folder, rng = tmp_path_factory.mktemp("t"), np.random.default_rng(seed)
    s = tried_set(rng, 20)
    t = attempts_of(rng, s)
    path = save_trajectories(folder, s, t)
    data = path.read_bytes()
    assert_same(t, load_trajectories(folder, s))
    assert save_trajectories(folder, s, t).read_bytes() == data


def test_in_a_session_they_are_listed_with_their_checksum(tmp_path):
    camera = CameraIntrinsics(width=64, height=48, fx=50, fy=50, cx=32, cy=24)
    store = begun(tmp_path, camera, unit_m=1e-3)
    rng = np.random.default_rng(2)
    s = tried_set(rng, 20)
    t = attempts_of(rng, s)
    stores.save_grasps(store, s)
    path = save_trajectories(store, s, t)
    store = stores.SessionStore.open(tmp_path)
    assert store.verify() == []
    for where in (store, tmp_path, tmp_path / "grasps"):
        assert_same(t, load_trajectories(where, stores.load_grasps(store)[0]))
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    assert [f.path for f in store.verify()] == [path.relative_to(tmp_path).as_posix()]


def test_where_none_were_kept_there_are_none(tmp_path):
    assert load_trajectories(tmp_path, tried_set(np.random.default_rng(0), 3)) is None


def test_attempts_of_other_grasps_are_refused(tmp_path):
    rng = np.random.default_rng(3)
    s = tried_set(rng, 20)
    t = attempts_of(rng, s)
    save_trajectories(tmp_path, s, t)
    moved = s.Ts_obj_grasp @ se3.from_translation([0.0, 0.0, 1e-6])
    refused("other grasps", load_trajectories, tmp_path, replace(s, Ts_obj_grasp=moved))
    refused("rows", save_trajectories, tmp_path, s, replace(t, rows=t.rows + 100))
    # What the scores became later does not make them other grasps.
    assert load_trajectories(tmp_path, replace(s, measures={})) is not None


def test_a_torn_file_is_named(tmp_path):
    rng = np.random.default_rng(4)
    s = tried_set(rng, 20)
    path = save_trajectories(tmp_path, s, attempts_of(rng, s))
    data = path.read_bytes()
    for share in (0.0, 0.3, 0.7, 0.99):
        path.write_bytes(data[: int(share * len(data))])
        refused("not a complete file of trajectories", load_trajectories, tmp_path, s)
