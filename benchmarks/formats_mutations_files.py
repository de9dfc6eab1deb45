"""Small valid files of every other format: grasps, recordings, meshes, images, archives."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from formats_mutations_scenes import Sample, drain_source

EXTENTS = {"brick": (0.06, 0.04, 0.1), "slab": (0.12, 0.05, 0.02)}


# --- grasps ---------------------------------------------------------------------------------------


def make_grasps_h5(folder: Path) -> None:
    """Write a scene's grasps as realsim's HDF5."""
    from realsim.formats.grasps.hdf5 import write_grasps_hdf5
    from tried_grasps import tried_scene

    write_grasps_hdf5(folder / "g.h5", tried_scene(4))


def read_grasps_h5(folder: Path) -> Any:
    """Read it."""
    from realsim.formats.grasps.hdf5 import read_grasps_hdf5

    return read_grasps_hdf5(folder / "g.h5")


def make_group(folder: Path) -> None:
    """Write grasps as GraspNet's npy."""
    from realsim.formats.graspnet.grasp_group import GraspGroup, write_grasp_group
    from realsim.geometry import se3

    rng = np.random.default_rng(0)
    n = 12
    Ts = se3.random_transform(rng, n, 0.1)
    Ts[:, :3, :3] = np.eye(3)
    Ts[:, 2, 3] += 0.6
    group = GraspGroup(
        Ts_a_grasp=Ts, scores=rng.random(n), openings_m=rng.uniform(0, 0.1, n),
        heights_m=np.full(n, 0.02), depths_m=np.full(n, 0.02), obj_ids=rng.integers(1, 89, n),
    )  # fmt: skip
    write_grasp_group(folder / "group.npy", group)


def read_group(folder: Path) -> Any:
    """Read it."""
    from realsim.formats.graspnet.grasp_group import read_grasp_group

    return read_grasp_group(folder / "group.npy")


def make_grasp_labels(folder: Path) -> None:
    """Write GraspNet's labels of an object."""
    from realsim.formats.graspnet import gripper_frame
    from realsim.formats.graspnet.grasp_labels import GraspLabels, write_grasp_labels

    rng = np.random.default_rng(0)
    grid = (3, gripper_frame.VIEWS, gripper_frame.ANGLES, gripper_frame.DEPTHS)
    flat = np.sort(rng.choice(int(np.prod(grid)), 60, replace=False))
    index = np.stack(np.unravel_index(flat, grid), axis=1)
    labels = GraspLabels(
        points=rng.uniform(-0.1, 0.1, (3, 3)).astype(np.float32), index=index,
        angles_rad=gripper_frame.angles_rad()[index[:, 2]],
        depths_m=np.array(gripper_frame.DEPTHS_M)[index[:, 3]],
        openings_m=rng.uniform(0.01, 0.1, 60), friction=rng.integers(1, 11, 60) / 10,
        collision=rng.random(60) < 0.4,
    )  # fmt: skip
    write_grasp_labels(folder / "000_labels.npz", labels)


def read_grasp_label_files(folder: Path) -> Any:
    """Read them."""
    from realsim.formats.graspnet.grasp_labels import read_grasp_labels

    return read_grasp_labels(folder / "000_labels.npz", with_collision=True)


def make_graspit(folder: Path) -> None:
    """Write a scene of the paper's authors: scene.yaml, meshes, grasps.hdf5."""
    import h5py
    import trimesh

    from realsim.geometry import se3

    lines = ["grasp_path: scenes/scene_0/grasps.hdf5"]
    with h5py.File(folder / "grasps.hdf5", "w") as file:
        for k, (name, extents) in enumerate(EXTENTS.items()):
            R = se3.exp_so3(np.array([0.0, 0.0, 0.4 + k]))
            T = se3.from_rt(R, [0.2 * k, -0.1 * k, 0.8 + extents[2] / 2])
            z = np.array([0.0, 0.0, -1.0])
            y = T[:3, 0]
            grasp = np.stack([np.cross(y, z), y, z], axis=1)
            along = np.linspace(-0.005, 0.005, 10)[:, None] * z + 0.012 * np.cross(y, z)
            Ts = se3.from_rt(np.tile(grasp, (10, 1, 1)), T[:3, 3] + along)
            file[name] = np.stack([Ts, Ts @ np.diag([-1.0, -1.0, 1.0, 1.0])], axis=1)
            mesh: Any = trimesh.creation.box(extents).export(file_type="stl")
            (folder / f"{name}.stl").write_bytes(mesh)
            q = se3.quaternion_wxyz(T[:3, :3])
            lines += [
                f"object{k + 1}:", f"  file_path: assets/{name}.usd", f"  name: {name}",
                f"  orientation: {[float(v) for v in q]}",
                f"  position: {[float(v) for v in T[:3, 3]]}", f"  scale: {[1.0] * 3}",
            ]  # fmt: skip
    lines += ["table:", "  file_path: assets/table.obj", "  name: table"]
    lines += ["  orientation: [0.0, 0.0, 0.0, 0.0]", "  position: [0.0, 0.0, 0.0]"]
    (folder / "scene.yaml").write_text("\n".join(lines))


def read_graspit(folder: Path) -> Any:
    """Read scene and grasps."""
    from realsim.formats.graspit.scene import read_graspit_scene

    return read_graspit_scene(folder)


# --- recordings and folders -----------------------------------------------------------------------


def _bag(kind: str) -> Sample:
    def make(folder: Path) -> None:
        from written_bags import recorded

        recorded(folder, kind, 3)

    def read(folder: Path) -> Any:
        from realsim.formats.bags import open_bag

        path = folder / ("recording.bag" if kind == "ros1" else "recording")
        return drain_source(open_bag(path))

    return Sample(f"bag {kind}", make, read)


def _pixels(k: int) -> tuple[Any, Any]:
    rng = np.random.default_rng(k)
    rgb = rng.integers(0, 256, (30, 40, 3), dtype=np.uint8)
    return rgb, rng.integers(400, 900, (30, 40)).astype(np.uint16)


def _folder(ending: str) -> Sample:
    def make(folder: Path) -> None:
        import cv2

        for k in range(3):
            rgb, depth = _pixels(k)
            cv2.imwrite(str(folder / f"rgb_{k:04d}.{ending}"), rgb)
            cv2.imwrite(str(folder / f"depth_{k:04d}.png"), depth)
        camera = {"width": 40, "height": 30, "fx": 35, "fy": 35, "cx": 20, "cy": 15}
        (folder / "camera.json").write_text(json.dumps(camera))
        T = "1 0 0 0.1\n0 1 0 0.2\n0 0 1 0.3\n0 0 0 1\n"
        (folder / "cam.info.txt").write_text(
            "# Environment: shelf\n\n# Color camera intrinsic matrix\n35 0 20\n0 35 15\n0 0 1\n\n"
            f"# Camera-to-world extrinsic matrix (camera pose) for frame-000001\n{T}"
        )

    def read(folder: Path) -> Any:
        from realsim.formats.folders import FolderChoice, list_folder, open_folder, read_cam_info
        from realsim.records import CameraIntrinsics

        camera = CameraIntrinsics(width=40, height=30, fx=35, fy=35, cx=20, cy=15)
        listing = list_folder(folder)
        source = open_folder(
            folder, camera, choice=FolderChoice(depth_unit_m=0.001), listing=listing
        )
        return [drain_source(source), read_cam_info(folder / "cam.info.txt")]

    return Sample(f"folder {ending}", make, read)


CAMERA_FORMATS = {"realsim": "a.json", "ros": "b.yaml", "opencv": "c.yaml"}


def make_camera_files(folder: Path) -> None:
    """Write a camera in every format that a folder of images may have it in, and robot poses."""
    from realsim.records import CameraIntrinsics
    from realsim_calibration.lens.camera_files import write_camera

    camera = CameraIntrinsics(width=640, height=480, fx=600.0, fy=601.0, cx=320.0, cy=240.0)
    for name, file in CAMERA_FORMATS.items():
        write_camera(folder / file, camera, format=name)
    (folder / "K.txt").write_text("600 0 320\n0 600 240\n0 0 1\n")
    rows = [[0.1 * k, 0.2, 0.3, 0.0, 0.0, 0.1 * k] for k in range(5)]
    (folder / "poses.json").write_text(json.dumps(rows))
    (folder / "poses.csv").write_text("\n".join(",".join(map(str, row)) for row in rows))


def read_camera_files(folder: Path) -> Any:
    """Read all of them; a file that is refused does not keep the next one from being read."""
    from realsim.app.importing.folder import camera_of_file
    from realsim.errors import InputError
    from realsim_calibration.inputs.pose_file import read_pose_file

    found: list[Any] = []
    refused: list[InputError] = []
    for name in (*CAMERA_FORMATS.values(), "K.txt", "poses.json", "poses.csv"):
        try:
            if name.startswith("poses"):
                read_pose_file(folder / name)  # it says itself which rows are not finite
            else:
                found.append(camera_of_file(folder / name, (640, 480)))
        except InputError as error:
            refused.append(error)
    if refused:
        raise refused[0]
    return found


# --- meshes ---------------------------------------------------------------------------------------


def _mesh(ending: str) -> Sample:
    def make(folder: Path) -> None:
        from realsim.geometry.mesh_files import ply_bytes
        from written_meshes import as_trimesh, textured_box, write_textured_obj, write_usd

        box = textured_box()
        if ending.startswith("usd"):
            write_usd(folder / f"a.{ending}", box)
        elif ending == "obj":
            write_textured_obj(folder / "a.obj", box)
        elif ending.endswith("ply"):
            (folder / "a.ply").write_bytes(ply_bytes(box, "m", ascii=ending.startswith("ascii")))
        else:
            data: Any = as_trimesh(box).export(file_type=ending)
            data = data.encode() if isinstance(data, str) else data
            (folder / f"a.{ending}").write_bytes(data)

    def read(folder: Path) -> Any:
        from realsim.geometry.mesh_files import load_mesh
        from realsim.models.reading import read_scan

        path = folder / f"a.{ending.rsplit(maxsplit=1)[-1]}"
        if ending in ("off", "usda", "usdc"):
            return read_scan(path, "m")
        return [load_mesh(path, "m", []), read_scan(path, "m")]

    return Sample(f"mesh {ending}", make, read)


# --- plain files ----------------------------------------------------------------------------------


def make_plain(folder: Path) -> None:
    """Write one file of each plain kind."""
    import scipy.io

    values = {"a": [1.5, 2, {"b": "text"}], "c": {"d": None, "e": True}}
    (folder / "a.json").write_text(json.dumps(values))
    (folder / "a.yaml").write_text("a: &x [1.5, 2, {b: text}]\nc: {d: null, e: true}\nf: *x\n")
    (folder / "a.xml").write_text('<?xml version="1.0"?><a n="1"><b>1 2</b><c><d/></c></a>')
    np.save(folder / "a.npy", np.arange(12.0).reshape(3, 4))
    np.savez_compressed(folder / "a.npz", x=np.arange(50), y=np.zeros((3, 4), np.float32))
    scipy.io.savemat(folder / "a.mat", {"K": np.eye(3), "n": np.arange(5)}, do_compression=True)


def read_plain(folder: Path) -> Any:
    """Read all of them."""
    from realsim.untrusted.arrays import read_npy, read_npz
    from realsim.untrusted.json_text import read_json
    from realsim.untrusted.mat_files import read_mat
    from realsim.untrusted.xml_tree import read_xml
    from realsim.untrusted.yaml_text import read_yaml

    texts = [read_json(folder / "a.json"), read_yaml(folder / "a.yaml")]
    read_xml(folder / "a.xml")
    arrays = [read_npy(folder / "a.npy"), read_npz(folder / "a.npz")]
    found = read_mat(folder / "a.mat", ["K", "n"])
    # NaN is a number in arrays: what it means is for their readers to say.
    return [texts, [a.shape for a in found.values()], len(arrays)]


def _archive(ending: str) -> Sample:
    def make(folder: Path) -> None:
        import tarfile
        import zipfile

        path, data = folder / f"a.{ending}", np.random.default_rng(0).bytes(3000)
        (folder / "x").write_bytes(data)
        if ending == "zip":
            with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
                for name in ("train/000001/a.json", "b.bin"):
                    archive.write(folder / "x", name)
        else:
            with tarfile.open(path, "w:gz" if ending == "tar.gz" else "w") as tar:
                for name in ("train/000001/a.json", "b" * 120):
                    tar.add(folder / "x", name)
        (folder / "x").unlink()

    def read(folder: Path) -> Any:
        from realsim.untrusted.archives import extract, members

        path = folder / f"a.{ending}"
        return [members(path), extract(path, folder / "out", most_bytes=1e6)]

    return Sample(f"archive {ending}", make, read)


FILES = (
    Sample("grasps h5", make_grasps_h5, read_grasps_h5),
    Sample("grasp group", make_group, read_group),
    Sample("grasp labels", make_grasp_labels, read_grasp_label_files),
    Sample("graspit", make_graspit, read_graspit),
    *(_bag(kind) for kind in ("ros1", "sqlite3", "mcap")),
    *(_folder(ending) for ending in ("png", "jpg", "tif", "webp")),
    Sample("camera files", make_camera_files, read_camera_files),
    *(_mesh(ending) for ending in ("ply", "ascii ply", "obj", "stl", "glb", "off", "usda", "usdc")),
    Sample("plain files", make_plain, read_plain),
    *(_archive(ending) for ending in ("zip", "tar", "tar.gz")),
)
