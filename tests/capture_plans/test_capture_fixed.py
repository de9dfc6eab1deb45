"""Fixed cameras beside the one in the hand during a capture."""

from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from given_plans import QUICK
from realsim.app.capture.fixed import fixed_stores, open_fixed, serials_of
from realsim.errors import InputError
from realsim.records import CameraIntrinsics
from realsim.store import SessionStore
from realsim.store.cameras import open_cameras
from realsim_capture_plans.capturing.capture import capture
from realsim_capture_plans.capturing.run import CaptureJob, CaptureSummary
from realsim_capture_plans.devices.interfaces import DeviceError, Frame
from refusals import refused
from tests.capture_plans.test_capture import KinematicArm, TableCamera, new_store, plan

LENS = CameraIntrinsics(width=32, height=24, fx=30.0, fy=30.0, cx=15.5, cy=11.5)


@dataclass
class StillCamera:
    """Counts its frames in their grey value; gives none where `fails_at` says so."""

    name: str = "still 1"
    fails_at: int = -1
    taken: int = 0
    intrinsics: CameraIntrinsics = LENS
    depth_unit_m: float = 2e-4
    description: dict[str, Any] = field(default_factory=dict)

    def grab(self) -> Frame:
        if self.taken == self.fails_at:
            self.fails_at = -1
            raise DeviceError("the fixed camera gave no frame.")
        self.taken += 1
        rgb = np.full((24, 32, 3), self.taken, np.uint8)
        return Frame(rgb=rgb, depth_m=np.full((24, 32), 0.7, np.float32), time_s=float(self.taken))

    def recover(self) -> None:
        pass


def taken(arm: KinematicArm, store: SessionStore, fixed: Any, **job: Any) -> CaptureSummary:
    work = CaptureJob(fixed=fixed, **job)
    return capture(plan(), arm, TableCamera(arm), store, config=QUICK, job=work)


@pytest.fixture
def arm() -> KinematicArm:
    return KinematicArm(joints=plan().home.copy())


def test_each_view_has_a_frame_of_each_fixed_camera(tmp_path: Path, arm: KinematicArm) -> None:
    store, still = new_store(tmp_path / "s", plan().content_hash), StillCamera()
    assert taken(arm, store, fixed_stores(store, {"left": still}), views=(0, 2, 3)).complete
    left = open_cameras(SessionStore.open(store.folder))["left"]
    assert [v.index for v in left.session.views] == [0, 2, 3]
    assert [int(left.rgb(k)[0, 0, 0]) for k in (0, 2, 3)] == [1, 2, 3]
    assert np.allclose(left.depth_m(2), 0.7)
    assert (left.session.intrinsics.width, left.session.depth_unit_m) == (32, 2e-4)
    assert left.check().sound and store.check().sound


def test_a_view_counts_when_all_cameras_have_it(tmp_path: Path, arm: KinematicArm) -> None:
    store, still = new_store(tmp_path / "s", plan().content_hash), StillCamera(fails_at=1)
    fixed = fixed_stores(store, {"left": still})
    refused("camera gave no frame", taken, arm, store, fixed, views=(0, 1), error=DeviceError)
    assert store.completed == {0}
    again = SessionStore.open(store.folder)
    assert taken(arm, again, fixed_stores(again, {"left": still}), views=(0, 1)).complete
    assert open_cameras(again)["left"].completed == again.completed == {0, 1}


def test_a_view_that_is_taken_again_is_of_all_cameras(tmp_path: Path, arm: KinematicArm) -> None:
    store, still = new_store(tmp_path / "s", plan().content_hash), StillCamera()
    fixed = fixed_stores(store, {"left": still})
    taken(arm, store, fixed, views=(0, 1))
    taken(arm, store, fixed, views=(), retake=(1,))
    left = open_cameras(store)["left"]
    assert [int(left.rgb(k)[0, 0, 0]) for k in (0, 1)] == [1, 3]


def test_a_capture_goes_on_with_the_cameras_it_was_begun_with(
    tmp_path: Path, arm: KinematicArm
) -> None:
    store, still = new_store(tmp_path / "s", plan().content_hash), StillCamera()
    taken(arm, store, fixed_stores(store, {"left": still}), views=(0,))
    refused(r"begun with the fixed cameras left, and .* names none", fixed_stores, store, {})
    refused("names left, right", fixed_stores, store, {"left": still, "right": StillCamera()})
    with pytest.raises(InputError, match=r"'left' of .* is still 1, .* connects still 2"):
        fixed_stores(store, {"left": StillCamera(name="still 2")})


@pytest.mark.parametrize("text", ["left", "left=", "=12", "left=1,left=2", "left=1,right=1"])
def test_other_forms_of_the_option_are_refused(text: str) -> None:
    refused("left=SERIAL,right=SERIAL is expected", serials_of, text)


def test_the_simulated_lab_has_no_fixed_camera() -> None:
    assert serials_of("left=12, top=34") == {"left": "12", "top": "34"}
    refused("no name of a camera", serials_of, "a/b=12")
    with ExitStack() as stack, pytest.raises(InputError, match="simulated lab has one camera"):
        open_fixed("left=12", True, stack)
