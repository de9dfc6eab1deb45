"""Parquet tables of grasps: what is written stands there bit for bit, and anybody can query it."""

import json

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
from hypothesis import given, settings
from hypothesis import strategies as st

from realsim.formats.grasps.hdf5 import COLUMNS
from realsim.formats.grasps.parquet import write_grasps_parquet
from realsim.records import STAGES
from tried_grasps import tried_scene


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1), st.booleans(), st.booleans())
def test_every_number_stands_in_the_table_bit_for_bit(tmp_path_factory, seed, poses, attempts):
    scene = tried_scene(seed, with_poses=poses, with_attempts=attempts)
    folder = tmp_path_factory.mktemp("pq")
    path = write_grasps_parquet(folder, scene)
    first, table = path.read_bytes(), pq.read_table(path)
    head = json.loads(table.schema.metadata[b"realsim"])
    assert [e["instance"] for e in head["sets"]] == [s.instance for s in scene.sets]
    for s, entry in zip(scene.sets, head["sets"], strict=True):
        mine = table.filter(pc.equal(table["instance"], s.instance))
        assert entry["parameters"] == s.parameters and mine.num_rows == len(s) == entry["grasps"]
        assert mine["failure"].to_pylist() == list(s.failures)
        assert mine["reachable"].to_pylist() == s.reachable.tolist()
        Ts = np.array(mine["T_obj_grasp"].to_pylist()).reshape(-1, 4, 4)
        assert np.array_equal(Ts, s.Ts_obj_grasp)
        named = {name: getattr(s, field) for name, (field, _, _) in COLUMNS.items()} | s.measures
        for name, values in named.items():
            stages = [f"{name}_{stage}" for stage in STAGES] if values.ndim == 2 else [name]
            for column, known in zip(stages, np.atleast_2d(values.T), strict=True):
                assert mine[column].null_count == 0
                assert np.array_equal(mine[column].to_numpy(), known, equal_nan=True)
    for instance, known in scene.trajectories.items():
        every = pq.read_table(folder / "trajectories.parquet")
        mine = every.filter(pc.equal(every["instance"], instance))
        assert mine["grasp"].to_pylist() == known.rows.tolist()
        for name in ("time_s", "opening_m", "phase"):
            flat = pc.list_flatten(mine[name]).to_numpy()
            assert np.array_equal(flat, getattr(known, name))
        angles = pc.list_flatten(pc.list_flatten(mine["joints_rad"])).to_numpy()
        assert np.array_equal(angles, known.joints_rad.ravel())
    assert write_grasps_parquet(folder, scene).read_bytes() == first


def test_a_stranger_can_ask_the_table(tmp_path):
    scene = tried_scene(4)
    table = pq.read_table(write_grasps_parquet(tmp_path, scene))
    assert table.num_rows == sum(len(s) for s in scene.sets)
    good = table.filter(pc.greater_equal(table["score"], 0.5))
    assert good.num_rows == sum(int(s.good.sum()) for s in scene.sets)
    field = table.schema.field("slip_m_lift")
    assert field.metadata[b"unit"] == b"m" and b"lost" in field.metadata[b"meaning"]
    # A measure that was not taken is null; NaN stays a number.
    with_margin = [s for s in scene.sets if "margin" in s.measures]
    assert table["margin"].null_count == table.num_rows - sum(len(s) for s in with_margin)
    assert np.isnan(table["margin"].drop_null().to_numpy()).any()
    s = next(s for s in scene.sets if s.instance == 4)
    mine = table.filter(pc.equal(table["instance"], 4))
    poses = np.array(mine["T_world_grasp"].to_pylist()).reshape(-1, 4, 4)
    np.testing.assert_array_equal(poses, scene.Ts_world_obj[4] @ s.Ts_obj_grasp)
    attempts = pq.read_table(tmp_path / "trajectories.parquet")
    row = attempts.filter(pc.equal(attempts["instance"], 4)).slice(1, 1).to_pylist()[0]
    part = scene.trajectories[4].attempt(row["grasp"])
    np.testing.assert_array_equal(row["joints_rad"], scene.trajectories[4].joints_rad[part])
    np.testing.assert_array_equal(row["time_s"], scene.trajectories[4].time_s[part])


def test_attempts_of_an_earlier_run_do_not_stay(tmp_path):
    write_grasps_parquet(tmp_path, tried_scene(1))
    write_grasps_parquet(tmp_path, tried_scene(1, with_attempts=False))
    assert [p.name for p in tmp_path.iterdir()] == ["grasps.parquet"]
