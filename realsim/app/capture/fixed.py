"""`realsim capture --fixed-cameras`: cameras that stand still, grabbed at every view."""

from contextlib import ExitStack
from pathlib import Path

from realsim.errors import InputError
from realsim.records import CaptureSession
from realsim.store import SessionStore
from realsim.store.cameras import camera_folder, camera_folders
from realsim_capture_plans.devices.interfaces import DepthCamera

FixedStores = list[tuple[DepthCamera, SessionStore]]


def serials_of(text: str) -> dict[str, str]:
    """Return the serial numbers of "left=SERIAL,right=SERIAL" by name.

    Raises:
        InputError: another form, a name that no folder can have, or one of both twice.
    """
    found: dict[str, str] = {}
    for part in text.split(",") if text else ():
        name, _, serial = (p.strip() for p in part.partition("="))
        if not name or not serial or name in found or serial in found.values():
            raise InputError(
                f"--fixed-cameras has '{part.strip()}'; left=SERIAL,right=SERIAL is expected, each "
                "name and each serial number once."
            )
        camera_folder(Path(), name)  # refuses what is no name
        found[name] = serial
    return found


def open_fixed(text: str, simulated: bool, stack: ExitStack) -> dict[str, DepthCamera]:
    """Connect the cameras of `serials_of`; they are closed with the stack.

    Raises:
        InputError: another form, or the simulated lab, which has one camera.
        DeviceError: a camera is not there.
    """
    from realsim_capture_plans.devices.realsense import RealSenseCamera

    serials = serials_of(text)
    if serials and simulated:
        raise InputError(
            "--fixed-cameras are RealSense cameras, and the simulated lab has one camera, in the "
            "hand. Leave the option out."
        )
    found: dict[str, DepthCamera] = {}
    for name, serial in serials.items():
        camera = RealSenseCamera(serial)
        stack.callback(camera.close)
        found[name] = camera
    return found


def fixed_stores(store: SessionStore, cameras: dict[str, DepthCamera]) -> FixedStores:
    """Begin, or go on with, the session of every fixed camera inside the one of the hand.

    Raises:
        InputError: the capture was begun with other cameras.
    """
    there = camera_folders(store.folder)
    if store.completed and set(there) != set(cameras):
        raise InputError(
            f"the session '{store.folder}' was begun with "
            f"{'the fixed cameras ' + ', '.join(there) if there else 'no fixed camera'}, and "
            f"--fixed-cameras names {', '.join(cameras) or 'none'}: its views would not be of all "
            "cameras. Give the same ones, or a new folder."
        )
    found: FixedStores = []
    for name, camera in cameras.items():
        folder = camera_folder(store.folder, name)
        if name in there:
            own = SessionStore.open(folder)
            if own.extra.get("camera") != camera.name:
                raise InputError(
                    f"the fixed camera '{name}' of '{store.folder}' is {own.extra.get('camera')}, "
                    f"and --fixed-cameras connects {camera.name}. Give the serial number of the "
                    "first one, or a new folder."
                )
        else:
            session = CaptureSession(
                name=f"{store.session.name}-{name}", intrinsics=camera.intrinsics,
                depth_unit_m=camera.depth_unit_m,
            )  # fmt: skip
            header = {"camera": camera.name, "camera_description": camera.description}
            own = SessionStore.create(folder, session, header)
        found.append((camera, own))
    return found
