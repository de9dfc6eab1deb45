"""The layouts in which labs keep poses beside images, each written for the same poses.

`LAYOUTS` maps a name to what writes it: (folder, poses (n, 4, 4), pictures) -> (images, poses,
reading), as `realsim calibrate IMAGES --poses POSES --reading READING` takes them; the reading is
"" where the file states it. `PAIRS` is the same for files of pose pairs without images.
"""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from pictured_folders import save_pictures
from pose_rows import rows_of, write_lines
from realsim.arrays import Array, UInt8
from realsim.geometry import se3
from realsim_calibration.inputs.readings import reading_from_text

Written = tuple[Path, Path, str]
QUATERNION = reading_from_text("quat_xyzw,m")
ROTVEC = reading_from_text("rotvec,m")


def tiny(k: int) -> UInt8:
    """Return a small picture, another for every number."""
    return np.random.default_rng(k).integers(0, 256, (24, 32, 3), dtype=np.uint8)


def save_images(folder: Path, shots: list[UInt8], pattern: str = "{:02d}.png") -> list[str]:
    """Write pictures; return their names."""
    return [str(p.relative_to(folder)) for p in save_pictures(folder, shots, pattern)]


def quaternion(T: Array) -> dict[str, float]:
    """Return one pose by names."""
    row = rows_of(QUATERNION, T[None])[0].tolist()
    return dict(zip(("x", "y", "z", "qx", "qy", "qz", "qw"), row, strict=True))


def ros(T: Array) -> dict[str, dict[str, float]]:
    """Return one pose as a geometry_msgs/Pose."""
    named = quaternion(T)
    turn = {n: named[f"q{n}"] for n in "xyzw"}
    return {"position": {n: named[n] for n in "xyz"}, "orientation": turn}


def visp(values: list[float]) -> str:
    """Return a pose vector as ViSP's vpPoseVector::saveYAML writes it."""
    lines = "".join(f"  - [{v!r}]\n" for v in values)
    return f"# pose\nrows: {len(values)}\ncols: 1\ndata:\n{lines}"


def text_by_number(d: Path, Ts: Array, shots: list[UInt8]) -> Written:
    """Line i of a txt belongs to image i."""
    save_images(d, shots, "0-{}.jpg")
    return d, write_lines(d / "poses.txt", rows_of(ROTVEC, Ts)), "rotvec,m"


def text_by_name(d: Path, Ts: Array, shots: list[UInt8]) -> Written:
    """Every line begins with the image's name."""
    names = save_images(d, shots)
    return d, write_lines(d / "poses.txt", rows_of(ROTVEC, Ts), names=names), "rotvec,m"


def csv_with_names(d: Path, Ts: Array, shots: list[UInt8]) -> Written:
    """A csv with a header, units in it, millimetres and degrees."""
    names = save_images(d, shots)
    rows = rows_of(reading_from_text("euler_xyz,deg,mm"), Ts)
    head = "image,x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg"
    return d, write_lines(d / "poses.csv", rows, ",", names, head), "euler_xyz,deg,mm"


def matrices_in_text(d: Path, Ts: Array, shots: list[UInt8]) -> Written:
    """4x4 matrices, four lines each."""
    save_images(d, shots)
    return d, write_lines(d / "poses.txt", Ts.reshape(-1, 4)), ""


def json_list(d: Path, Ts: Array, shots: list[UInt8]) -> Written:
    """A json with a list of matrices and one of image names."""
    names = save_images(d, shots)
    (d / "poses.json").write_text(json.dumps({"poses": Ts.tolist(), "images": names}))
    return d, d, ""


def json_by_image(d: Path, Ts: Array, shots: list[UInt8]) -> Written:
    """A json from image to pose."""
    names = save_images(d, shots)
    (d / "poses.json").write_text(json.dumps(dict(zip(names, Ts.tolist(), strict=True))))
    return d, d, ""


def json_frames(d: Path, Ts: Array, shots: list[UInt8]) -> Written:
    """NeRF's transforms.json: frames with a file_path and a transform_matrix."""
    frames = [
        {"file_path": f"images/{n}", "transform_matrix": T.tolist()}
        for n, T in zip(save_images(d / "images", shots), Ts, strict=True)
    ]
    (d / "transforms.json").write_text(json.dumps({"frames": frames}))
    return d, d, ""


def json_beside(d: Path, Ts: Array, shots: list[UInt8]) -> Written:
    """A json beside every image, with joints, as ur_rtde scripts write it."""
    save_images(d, shots, "{}.jpg")
    for k, row in enumerate(rows_of(ROTVEC, Ts)):
        joints = np.linspace(-1, 1, 6).tolist()
        (d / f"{k}.json").write_text(json.dumps({"joints": joints, "pose_flange": row.tolist()}))
    return d, d, "rotvec,m"


def text_beside(d: Path, Ts: Array, shots: list[UInt8]) -> Written:
    """A txt beside every image."""
    save_images(d, shots)
    for k, row in enumerate(rows_of(ROTVEC, Ts)):
        write_lines(d / f"{k:02d}.txt", row[None])
    return d, d, "rotvec,m"


def ros_messages(d: Path, Ts: Array, shots: list[UInt8]) -> Written:
    """PoseStamped messages as `ros2 topic echo` prints them, in one yaml."""
    save_images(d, shots)
    text = [json.dumps({"header": {"seq": k}, "pose": ros(T)}) for k, T in enumerate(Ts)]
    (d / "poses.yaml").write_text("\n---\n".join(text) + "\n")
    return d, d, ""


def ros_industrial(d: Path, Ts: Array, shots: list[UInt8]) -> Written:
    """images/, poses/*.yaml whose keys are sorted differently from file to file, cal_data.yaml."""
    save_images(d / "images", shots, "{}.png")
    (d / "poses").mkdir()
    data: list[dict[str, str]] = []
    for k, T in enumerate(Ts):
        items = list(quaternion(T).items())
        items = items[k % 7 :] + items[: k % 7]
        (d / "poses" / f"{k}.yaml").write_text("".join(f"{n}: {v!r}\n" for n, v in items))
        data.append({"image": f"images/{k}.png", "pose": f"poses/{k}.yaml"})
    (d / "cal_data.yaml").write_text(json.dumps({"data": data}))
    return d / "images", d / "poses", ""


def opencv_storage(d: Path, Ts: Array, shots: list[UInt8]) -> Written:
    """A FileStorage yml with a matrix of one row a pose."""
    import cv2

    save_images(d, shots)
    store = cv2.FileStorage(str(d / "poses.yml"), cv2.FileStorage_WRITE)
    store.write("poses", np.ascontiguousarray(rows_of(QUATERNION, Ts)))
    store.release()
    return d, d, "quat_xyzw,m"


def visp_beside(d: Path, Ts: Array, shots: list[UInt8]) -> Written:
    """pose_fPe_1.yaml beside image-1.png, the board's pose_cPo_1.yaml and camera.xml there, too."""
    save_images(d, shots, "image-{}.png")
    for k, row in enumerate(rows_of(ROTVEC, Ts)):
        (d / f"pose_fPe_{k}.yaml").write_text(visp(row.tolist()))
        (d / f"pose_cPo_{k}.yaml").write_text(visp([0.1, 0.0, 0.5, 0.0, 0.1, 0.0]))
    return d, d, ""


def folder_a_pose(d: Path, Ts: Array, shots: list[UInt8]) -> Written:
    """pose_00/data.json and image.png."""
    save_images(d, shots, "pose_{:02d}/image.png")
    for k, T in enumerate(Ts):
        (d / f"pose_{k:02d}" / "data.json").write_text(json.dumps({"T_base_ee": T.tolist()}))
    return d, d, ""


def images_below(d: Path, Ts: Array, shots: list[UInt8]) -> Written:
    """images/ and a pose file above."""
    save_images(d / "images", shots)
    return d, write_lines(d / "poses.txt", Ts.reshape(-1, 16)).parent, ""


def images_and_poses_below(d: Path, Ts: Array, shots: list[UInt8]) -> Written:
    """images/ and poses/ with a file each."""
    save_images(d / "images", shots)
    (d / "poses").mkdir()
    for k, T in enumerate(Ts):
        (d / "poses" / f"{k:02d}.json").write_text(json.dumps(quaternion(T)))
    return d, d, ""


def npy_stack(d: Path, Ts: Array, shots: list[UInt8]) -> Written:
    """An npy (n, 4, 4)."""
    save_images(d, shots)
    np.save(d / "poses.npy", Ts)
    return d, d, ""


def npz_with_names(d: Path, Ts: Array, shots: list[UInt8]) -> Written:
    """An npz with poses and image names."""
    np.savez(d / "poses.npz", poses=Ts, images=np.array(save_images(d, shots)))
    return d, d, ""


def npy_beside(d: Path, Ts: Array, shots: list[UInt8]) -> Written:
    """An npy beside every image."""
    save_images(d, shots)
    for k, T in enumerate(Ts):
        np.save(d / f"{k:02d}.npy", T)
    return d, d, ""


LAYOUTS: dict[str, Callable[[Path, Array, list[UInt8]], Written]] = {
    f.__name__: f
    for f in (
        text_by_number, text_by_name, csv_with_names, matrices_in_text, json_list, json_by_image,
        json_frames, json_beside, text_beside, ros_messages, ros_industrial, opencv_storage,
        visp_beside, folder_a_pose, images_below, images_and_poses_below, npy_stack,
        npz_with_names, npy_beside,
    )
}  # fmt: skip


# --- pose pairs without images: (folder, robot, board) -> (robot file or None, board file) ---


def pairs_json(d: Path, Ts: Array, Cs: Array) -> tuple[Path | None, Path]:
    """A json list of pairs."""
    rows = [{"robot": T.tolist(), "board": C.tolist()} for T, C in zip(Ts, Cs, strict=True)]
    (d / "pairs.json").write_text(json.dumps({"samples": rows}))
    return None, d / "pairs.json"


def pairs_moveit(d: Path, Ts: Array, Cs: Array) -> tuple[Path | None, Path]:
    """MoveIt's samples: effector_wrt_world and object_wrt_sensor, 16 numbers each."""
    rows = [
        {"effector_wrt_world": T.ravel().tolist(), "object_wrt_sensor": C.ravel().tolist()}
        for T, C in zip(Ts, Cs, strict=True)
    ]
    (d / "samples.yaml").write_text(json.dumps(rows))
    return None, d / "samples.yaml"


def pairs_of_lists(d: Path, Ts: Array, Cs: Array) -> tuple[Path | None, Path]:
    """Two lists in one json, gripper2base and target2cam."""
    text = json.dumps({"gripper2base": Ts.tolist(), "target2cam": Cs.tolist()})
    (d / "pairs.json").write_text(text)
    return None, d / "pairs.json"


def pairs_csv(d: Path, Ts: Array, Cs: Array) -> tuple[Path | None, Path]:
    """A csv with the columns robot_x ... board_qw."""
    names = ["x", "y", "z", "qx", "qy", "qz", "qw"]
    head = ",".join([f"robot_{n}" for n in names] + [f"board_{n}" for n in names])
    rows = np.hstack([rows_of(QUATERNION, Ts), rows_of(QUATERNION, Cs)])
    lines = [",".join(map(repr, r.tolist())) for r in rows]
    (d / "pairs.csv").write_text("\n".join([head, *lines]))
    return None, d / "pairs.csv"


def two_files(d: Path, Ts: Array, Cs: Array) -> tuple[Path | None, Path]:
    """A file for each."""
    np.save(d / "robot.npy", Ts)
    np.save(d / "board.npy", Cs)
    return d / "robot.npy", d / "board.npy"


def visp_pairs(d: Path, Ts: Array, Cs: Array) -> tuple[Path | None, Path]:
    """ViSP's pose_fPe_1.yaml and pose_cPo_1.yaml in one folder."""
    for k, (a, b) in enumerate(zip(rows_of(ROTVEC, Ts), rows_of(ROTVEC, Cs), strict=True)):
        (d / f"pose_fPe_{k}.yaml").write_text(visp(a.tolist()))
        (d / f"pose_cPo_{k}.yaml").write_text(visp(b.tolist()))
    return d, d


PAIRS: dict[str, Callable[[Path, Array, Array], tuple[Path | None, Path]]] = {
    f.__name__: f
    for f in (pairs_json, pairs_moveit, pairs_of_lists, pairs_csv, two_files, visp_pairs)
}


def layouts_read(place: Path, n: int = 7, seed: int = 3) -> dict[str, str]:
    """Write every layout and read it back; return what is wrong with each, "" where nothing is."""
    from realsim.errors import RealsimError
    from realsim_calibration.inputs.folder import read_board_poses, read_image_folder

    rng = np.random.default_rng(seed)
    Ts, Cs = (se3.random_transform(rng, n, spread=0.5) for _ in range(2))
    shots = [tiny(k) for k in range(n)]
    result: dict[str, str] = {}
    for name, write in LAYOUTS.items():
        folder = place / name
        folder.mkdir()
        images, poses, said = write(folder, Ts, shots)
        try:
            found = read_image_folder(images, poses)
            reading = reading_from_text(said) if said else found.poses.stated
            if reading is None or len(found) != n:
                result[name] = f"{len(found)} of {n} pairs, reading {reading}"
                continue
            off = float(np.abs(found.Ts_base_ee(reading) - Ts).max())
            result[name] = "" if off < 1e-9 else f"poses are off by {off:.2g}"
        except RealsimError as error:
            result[name] = str(error)
    for name, write_pairs in PAIRS.items():
        folder = place / name
        folder.mkdir()
        try:
            pairs = read_board_poses(*write_pairs(folder, Ts, Cs))
            sides = ((pairs.robot, Ts), (pairs.board, Cs))
            off = max(float(np.abs(raw.poses(raw.stated) - T).max()) if raw.stated else np.inf
                      for raw, T in sides)  # fmt: skip
            result[name] = "" if off < 1e-9 else f"poses are off by {off:.2g}"
        except (RealsimError, ValueError) as error:
            result[name] = str(error)
    return result
