"""Parquet tables of grasps: what is written is read bit for bit, and a stranger can query them."""

import json

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from realsim.errors import InputError, RealsimError
from realsim.formats.grasps.hdf5 import read_grasps_hdf5, write_grasps_hdf5
from realsim.formats.grasps.parquet import read_grasps_parquet, write_grasps_parquet
from tried_grasps import assert_same, tried_scene


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1), st.booleans(), st.booleans())
def test_grasps_written_and_read_are_the_same_bit_for_bit(tmp_path_factory, seed, poses, attempts):
    scene = tried_scene(seed, with_poses=poses, with_attempts=attempts)
    folder = tmp_path_factory.mktemp("pq")
    first = write_grasps_parquet(folder, scene).read_bytes()
    assert_same(scene, read_grasps_parquet(folder))
    assert write_grasps_parquet(folder, scene).read_bytes() == first


def test_hdf5_and_parquet_hold_the_same(tmp_path):
    scene = tried_scene(11)
    write_grasps_parquet(tmp_path, read_grasps_hdf5(write_grasps_hdf5(tmp_path / "g.h5", scene)))
    assert_same(scene, read_grasps_parquet(tmp_path))


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
    assert read_grasps_parquet(tmp_path).trajectories == {}


def test_tables_of_two_runs_are_not_mixed(tmp_path):
    write_grasps_parquet(tmp_path / "a", tried_scene(1))
    write_grasps_parquet(tmp_path / "b", tried_scene(2))
    (tmp_path / "b/trajectories.parquet").replace(tmp_path / "a/trajectories.parquet")
    with pytest.raises(InputError, match="not the table that"):
        read_grasps_parquet(tmp_path / "a")
    (tmp_path / "a/trajectories.parquet").unlink()
    with pytest.raises(InputError, match="is missing"):
        read_grasps_parquet(tmp_path / "a")


def rewritten(change_table=None, change_head=None):
    def change(path):
        table = pq.read_table(path)
        if change_table:
            table = change_table(table)
        head = json.loads(table.schema.metadata[b"realsim"])
        if change_head:
            change_head(head)
        pq.write_table(table.replace_schema_metadata({b"realsim": json.dumps(head)}), path)

    return change


def with_column(name, make):
    def change(table):
        k = table.schema.names.index(name)
        return table.set_column(k, name, make(table[name]))

    return rewritten(change)


def nulled(column):
    return pc.if_else(pc.equal(column, column[0]), None, column)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (rewritten(lambda t: t.drop_columns(["score"])), "'score' is missing"),
        (rewritten(lambda t: t.take(np.arange(t.num_rows)[::-1])), "not all of"),
        (with_column("grasp", lambda c: pc.multiply(c, 2)), "not in their order"),
        (with_column("width_m", nulled), "nulls"),
        (rewritten(None, lambda h: h.update(format_version=9)), "version 9"),
        (rewritten(None, lambda h: h["sets"][1].update(measures=["goodness"])), "no measure"),
    ],
)
def test_a_table_that_is_not_ours_is_refused(tmp_path, change, words):
    path = write_grasps_parquet(tmp_path, tried_scene(6))
    change(path)
    with pytest.raises(InputError, match=words):
        read_grasps_parquet(tmp_path)


def test_a_missing_and_a_torn_table_are_named(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        read_grasps_parquet(tmp_path)
    path = write_grasps_parquet(tmp_path, tried_scene(6))
    data = path.read_bytes()
    for share in np.linspace(0.02, 0.98, 20):
        path.write_bytes(data[: int(share * len(data))])
        with pytest.raises(RealsimError):
            read_grasps_parquet(tmp_path)
