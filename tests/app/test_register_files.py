"""Files of a registration: what is written is read, and a kill leaves the old or the new state."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike

from begun_sessions import add_drawn, begun, light_things
from realsim.app.annotate.current import annotate_session, what_is_stale
from realsim.app.console import Console
from realsim.app.register import results
from realsim.app.register.files import documents, finish_interrupted, write_result
from realsim.app.register.run import colour_remark
from realsim.app.report.session import report_of, write_report
from realsim.app.stages import judged_scene, registered_views
from realsim.geometry import se3
from realsim.records import CameraIntrinsics, ObjectPose, bop_units
from realsim.store import SessionStore, atomic
from realsim.store.session_repair import repair_session
from registered_sessions import CAMERA, models_of, registered_by_hand, table_renderer, true_cameras
from shared_sessions import copy_of

MODELS = models_of()


@pytest.fixture
def store(few_views: Path, tmp_path: Path) -> SessionStore:
    return SessionStore.open(copy_of(few_views, tmp_path / "s"))


def moved(result: results.Registered, by_m: float) -> results.Registered:
    """Return the same registration with everything elsewhere."""
    T = se3.from_translation([by_m, 0.0, 0.0])
    objects = tuple(replace(o, T_world_obj=T @ o.T_world_obj) for o in result.scene.objects)
    refined = {k: T @ c for k, c in result.cameras.refined.items()}
    return replace(
        result, scene=replace(result.scene, objects=objects),
        cameras=replace(result.cameras, refined=refined),
    )  # fmt: skip


def test_what_is_written_is_read_bit_for_bit(store: SessionStore) -> None:
    result = registered_by_hand(store)
    write_result(store, result, MODELS, {"registration/pictures/a.jpg": b"picture"})
    read = results.load_registered(SessionStore.open(store.folder))
    for a, b in zip(read.scene.objects, result.scene.objects, strict=True):
        assert np.array_equal(a.T_world_obj, b.T_world_obj)
        assert a.covariance is not None and b.covariance is not None
        assert np.array_equal(a.covariance, b.covariance)
        assert (a.verdict, a.reasons, a.checks) == (b.verdict, b.reasons, b.checks)
    for k, poses in result.seen.items():
        for i, pose in poses.items():
            assert np.array_equal(read.seen[k][i].covariance, pose.covariance)
            assert np.array_equal(read.seen[k][i].T_cam_obj, pose.T_cam_obj)
            assert read.seen[k][i].sigma_px == pose.sigma_px
    assert [n.reason for n in read.not_placed] == [n.reason for n in result.not_placed]
    assert read.remarks == result.remarks
    assert results.is_same_cameras(read.cameras.claimed, result.cameras.claimed)
    assert not store.has(results.NEXT_FILE)
    assert store.verify() == []


def test_the_session_has_the_refined_cameras_and_a_rerun_the_claimed_ones(
    store: SessionStore,
) -> None:
    before = store.session.Ts_world_cam
    result = registered_by_hand(store, left_out=3)
    write_result(store, result, MODELS, {})
    now = SessionStore.open(store.folder).session.Ts_world_cam
    for k in (0, 1, 2):
        np.testing.assert_allclose(now[k], result.cameras.refined[k], atol=1e-15)
    assert np.array_equal(now[3], before[3])  # it took no part
    claimed = results.claimed_cameras(store)
    assert set(claimed) == set(before)
    assert all(np.array_equal(claimed[k], before[k]) for k in before)
    # And once more: a second result does not make the first one's cameras the claim.
    write_result(store, moved(result, 1e-3), MODELS, {})
    assert all(np.array_equal(results.claimed_cameras(store)[k], before[k]) for k in before)


def test_cameras_that_were_calibrated_anew_are_the_claim(store: SessionStore) -> None:
    before = store.session.Ts_world_cam
    write_result(store, registered_by_hand(store), MODELS, {})
    other = {2: before[2] @ se3.from_translation([0.0, 0.001, 0.0])}
    store.set_cameras(store.session.intrinsics, other)
    claimed = results.claimed_cameras(store)
    np.testing.assert_allclose(claimed[2], other[2], atol=1e-15)
    assert np.array_equal(claimed[1], before[1])


class Killed(BaseException):
    """The process ends here."""


class MortalStore(SessionStore):
    """A session whose process dies when it is about to write its n-th file."""

    left = 0

    def _live(self) -> None:
        if self.left == 0:
            raise Killed
        self.left -= 1

    def write_bytes(self, relative: str, data: bytes) -> None:
        """Write, or die before it."""
        self._live()
        super().write_bytes(relative, data)

    def set_cameras(
        self, intrinsics: CameraIntrinsics, Ts_world_cam: Mapping[int, ArrayLike]
    ) -> None:
        """Set, or die before it."""
        self._live()
        super().set_cameras(intrinsics, Ts_world_cam)


def state_of(store: SessionStore, paths: list[str]) -> dict[str, bytes]:
    """Return everything that a registration writes, cameras included."""
    files = {p: store.path(p).read_bytes() for p in paths}
    return files | {"cameras": repr(store.session.views).encode()}


def test_a_kill_between_any_two_files_leaves_the_old_or_the_new_state(
    few_views: Path, tmp_path: Path
) -> None:
    states: list[dict[str, bytes]] = []
    seen: set[int] = set()
    for n in range(40):
        store = SessionStore.open(copy_of(few_views, folder := tmp_path / str(n)))
        old = registered_by_hand(store)
        new = moved(old, 0.01)
        paths = list(documents(old, store, MODELS))
        write_result(store, old, MODELS, {})
        if not states:
            states.append(state_of(store, paths))
            write_result(store, new, MODELS, {})
            states.append(state_of(store, paths))
            write_result(store, old, MODELS, {})
            assert state_of(store, paths) == states[0] != states[1]
        mortal = MortalStore.open(folder)
        assert isinstance(mortal, MortalStore)
        mortal.left = n
        try:
            write_result(mortal, new, MODELS, {})
        except Killed:
            again = SessionStore.open(folder)
            finish_interrupted(again)
            seen.add(states.index(state_of(SessionStore.open(folder), paths)))
            assert again.verify() == [] and not again.has(results.NEXT_FILE)
            continue
        assert state_of(SessionStore.open(folder), paths) == states[1]
        break
    else:
        pytest.fail("the writing never came to its end")
    assert seen == {0, 1}


def test_an_interrupted_result_of_other_cameras_is_thrown_away(store: SessionStore) -> None:
    result = registered_by_hand(store)
    write_result(store, result, MODELS, {})
    scene = store.path(results.SCENE_FILE).read_bytes()
    mortal = MortalStore.open(store.folder)
    assert isinstance(mortal, MortalStore)
    mortal.left = 1
    with pytest.raises(Killed):
        write_result(mortal, moved(result, 0.02), MODELS, {})
    again = SessionStore.open(store.folder)
    shift = se3.from_translation([0.0, 0.002, 0.0])
    calibrated = {k: T @ shift for k, T in result.cameras.claimed.items()}
    again.set_cameras(again.session.intrinsics, calibrated)
    assert not finish_interrupted(again)
    assert not again.has(results.NEXT_FILE) and again.path(results.SCENE_FILE).read_bytes() == scene
    np.testing.assert_allclose(again.session.Ts_world_cam[0], calibrated[0], atol=1e-15)


def test_bop_files_are_in_millimetres_and_leave_rejected_objects_out(store: SessionStore) -> None:
    result = registered_by_hand(store, left_out=3)
    first, second = result.scene.objects
    scene = replace(result.scene, objects=(first, replace(second, verdict="rejected")))
    write_result(store, replace(result, scene=scene), MODELS, {})
    gt = store.read_json("registration/scene_gt.json")
    cameras = store.read_json("registration/scene_camera.json")
    assert set(gt) == set(cameras) == {"0", "1", "2"}
    for k, rows in gt.items():
        assert [row["obj_id"] for row in rows] == [first.obj_id]
        T_cam_obj = bop_units.object_in_camera(rows[0]["cam_R_m2c"], rows[0]["cam_t_m2c"], k)
        T_world_cam = bop_units.T_world_cam_of(cameras[k], k)
        assert T_world_cam is not None
        np.testing.assert_allclose(T_world_cam @ T_cam_obj, first.T_world_obj, atol=1e-12)


def test_unknown_uncertainties_are_null_and_come_back_as_nan(store: SessionStore) -> None:
    result = registered_by_hand(store)
    pose = replace(result.seen[0][0], sigma_px=float("nan"), covariance=np.full((6, 6), np.nan))
    seen = result.seen | {0: result.seen[0] | {0: pose}}
    bare = ObjectPose(obj_id=MODELS[min(MODELS)].obj_id, instance=5, T_world_obj=np.eye(4))
    scene = replace(result.scene, objects=(*result.scene.objects, bare), plane=None)
    write_result(store, replace(result, seen=seen, scene=scene), MODELS, {})
    read = results.load_seen(store)[0][0]
    assert np.isnan(read.sigma_px) and np.isnan(read.covariance).all()
    assert store.read_json("registration/views.json")["views"]["0"]["0"]["sigma_mm"] is None
    assert store.read_json("registration/scene_table.json")["frame"] == "world"


# --- What other stages make of a registration: which views count, interrupted ones, notes, colour.
VIEWS = 5
QUIET = Console(quiet=True)


def test_views_that_were_left_out_get_no_labels_and_are_named(store: SessionStore) -> None:
    write_result(store, registered_by_hand(store), MODELS, {})
    assert registered_views(store) == [0, 1, 2, 3]
    whole = annotate_session(store, QUIET)
    assert whole.views == 4 and whole.views_left_out == () and "not registered" not in str(whole)
    # One view less than before: its labels of the earlier run go, too.
    write_result(store, registered_by_hand(store, left_out=2), MODELS, {})
    summary = annotate_session(SessionStore.open(store.folder), QUIET)
    assert (summary.views, summary.views_left_out) == (3, (2,))
    assert "1 not registered (2)" in str(summary)
    assert set(store.read_json("scene_gt.json")) == {"0", "1", "3"}
    assert not store.has("annotations/000002.json") and store.has("annotations/000003.json")
    assert not store.has("mask_visib/000002_000000.png")
    page = write_report(store, report_of(store, pictures="kept"))
    shown = {p.name for p in page.parent.glob("overlay_*.png")}
    assert shown == {f"overlay_{k:06d}.png" for k in (0, 1, 3)}


def test_labels_do_not_wait_for_a_view_that_was_taken_out_since(store: SessionStore) -> None:
    write_result(store, registered_by_hand(store), MODELS, {})
    store.path("rgb/000003.png").unlink()  # it is linked: what is written to it is written to all
    store.path("rgb/000003.png").write_bytes(b"damaged")
    repair_session(store.folder)
    left = SessionStore.open(store.folder)
    assert registered_views(left) == [0, 1, 2]
    annotate_session(left, QUIET)
    assert what_is_stale(left) == ""


def test_an_interrupted_registration_is_finished_by_whoever_comes_next(store: SessionStore) -> None:
    result = registered_by_hand(store, left_out=1)
    before = {str(k): T.tolist() for k, T in store.session.Ts_world_cam.items()}
    files = documents(result, store, MODELS)
    store.write_bytes(results.NEXT_FILE, atomic.json_bytes({"before": before, "files": files}))
    assert not store.has(results.SCENE_FILE)
    assert [o.instance for o in judged_scene(store).objects] == [0, 1]
    assert not store.has(results.NEXT_FILE)
    np.testing.assert_allclose(store.session.Ts_world_cam[0], result.cameras.refined[0], atol=1e-15)


# --- depth against colour ---------------------------------------------------------------------


def coloured(folder: Path, shift_px: int) -> SessionStore:
    """Return a session whose colour lies `shift_px` to the right of its depth."""
    camera = replace(CAMERA, width=640, height=480, fx=600.0, fy=600.0, cx=320.0, cy=240.0)
    return add_drawn(
        begun(folder, camera), table_renderer(), true_cameras(VIEWS),
        lambda ids: np.roll(light_things(ids), shift_px, axis=1),
    )  # fmt: skip


def test_depth_that_does_not_lie_on_colour_is_said_in_pixels(tmp_path: Path) -> None:
    remark = colour_remark(coloured(tmp_path / "off", 15), range(VIEWS))
    assert remark is not None and remark.kind == "not_aligned" and remark.view is None
    assert "15 px to the left of" in remark.words and f"of {VIEWS} views" in remark.words
