"""`realsim calibrate SESSION --check`: exit 0 where the camera sits as calibrated, 1 where not."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result

from realsim.app.register.files import write_result
from realsim.arrays import Array
from realsim.geometry import se3
from realsim.records import HandEye
from realsim.store import SessionStore, save_hand_eye
from registered_sessions import CAMERA, models_of, registered_by_hand, table_session
from shared_sessions import copy_of
from typed_commands import finished, invoked, refused

SLIP = np.array([0.004, -0.006, 0.002, 0.003, -0.001, 0.002])


@pytest.fixture(scope="module")
def pristine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session of ten views whose cameras are off by the arm's noise."""
    folder = tmp_path_factory.mktemp("check") / "s"
    return table_session(folder, views=10, sigma=(5e-4, 2e-4)).folder


def check(folder: Path, *options: str) -> Result:
    return invoked("calibrate", folder, "--check", *options)


def register(pristine: Path, folder: Path, slip: Array) -> Path:
    """Return a copy that is registered, its calibration wrong by a slip."""
    store = SessionStore.open(copy_of(pristine, folder))
    result = registered_by_hand(store)
    claimed = {k: T @ se3.exp(-slip) for k, T in result.cameras.claimed.items()}
    cameras = replace(result.cameras, claimed=claimed)
    write_result(store, replace(result, cameras=cameras), models_of(), {})
    return folder


def test_a_camera_that_sits_as_calibrated_holds(pristine: Path, tmp_path: Path) -> None:
    folder = register(pristine, tmp_path / "s", np.zeros(6))
    done = finished("calibrate", folder, "--check", "--json")
    assert json.loads(done.stdout)["holds"] is True


def test_a_camera_that_slipped_is_told_with_size_and_sigma(pristine: Path, tmp_path: Path) -> None:
    """A slip of 3.7 mm: exit code 1, its size within three sigma, and kept in the session."""
    folder = register(pristine, tmp_path / "s", SLIP)
    done = check(folder)
    assert done.exit_code == 1 and "does NOT hold" in done.output
    kept = json.loads((folder / "calibration/check.json").read_text())
    off = np.array(kept["twist"]) - SLIP
    assert off @ np.linalg.solve(np.array(kept["covariance"]), off) < 25.0
    assert check(folder, "--tolerance", "30").exit_code == 0  # a large one lets it pass


def test_what_cannot_be_checked_is_bad_input(pristine: Path, tmp_path: Path) -> None:
    """A folder that is no session, and one that is not registered, are refused with what to do."""
    for folder, words in ((tmp_path, "not a session"), (pristine, "run `realsim register")):
        assert words in refused("calibrate", folder, "--check")


def test_the_calibration_that_lies_there_now_is_checked(pristine: Path, tmp_path: Path) -> None:
    """A hand-eye that was changed after the registration is the one that does not hold."""
    source, X = SessionStore.open(pristine), se3.exp(10 * SLIP)
    store = SessionStore.create(tmp_path / "s", replace(source.session, views=()))
    for view in source.session.views:
        assert view.T_world_cam is not None
        hand = view.T_world_cam @ se3.invert(X)
        store.add_view(replace(view, T_base_ee=hand), source.rgb(view.index))
    write_result(store, registered_by_hand(store), models_of(), {})
    hand_eye = HandEye(
        T_ee_cam=X, covariance=1e-8 * np.eye(6), T_base_board=np.eye(4), intrinsics=CAMERA,
        intrinsics_sd=np.zeros(12), view_indices=(0,), view_rms_px=np.zeros(1), held_out_px=0.1,
    )  # fmt: skip
    save_hand_eye(store, hand_eye)
    assert check(store.folder, "--tolerance", "2").exit_code == 0
    aside = X @ se3.from_translation([0.005, 0.0, 0.0])
    save_hand_eye(store, replace(hand_eye, T_ee_cam=aside))
    done = check(store.folder, "--tolerance", "2")
    assert done.exit_code == 1 and "another calibration" in done.output
    found = json.loads((store.folder / "calibration/check.json").read_text())
    assert abs(found["moved_mm"] - 5.0) < 1.5


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--check", "--tolerance", "nan"], "above 0"),
        (["--check", "--tolerance", "-1"], "above 0"),
        (["--check", "--live"], "no meaning with --check"),
        (["--check", "--out", "xx"], "--out has no meaning with --check"),
        (["--tolerance", "2"], "belongs to --check"),
        (["--cameras", "a=hand", "--clock-offset", "0.1"], "one camera alone"),
    ],
)
def test_options_that_would_not_be_looked_at_are_refused(
    pristine: Path, tmp_path: Path, options: list[str], words: str
) -> None:
    assert words in refused("calibrate", pristine, *options)
