"""Formats of grasps: written by realsim, read as any other program reads them.

`raw` gives the hands' poses in a file, `read` the grasps that they are of.
"""

import json

import h5py
import numpy as np
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation

from realsim.formats.graspit.grasps import read_grasp_file
from realsim.formats.graspnet.grasp_group import grasp_group, read_grasp_group, write_grasp_group
from realsim.formats.grasps.acronym import AcronymObject, write_acronym
from realsim.formats.grasps.graspgen import write_graspgen
from realsim.formats.grasps.hand_frames import grasp_poses
from realsim.formats.grasps.isaac_grasp import write_isaac_grasp
from realsim.formats.grasps.scene_grasps import executed
from realsim.geometry import se3

MOUNT, TIP = 0.1034, 0.1122
"""Tool centre point and fingertips before the hand's mounting face [m] (franka_description)."""


class Acronym:
    rounding = 1e-15
    approach, closing = 2, 0
    tip = (0, 0, TIP)

    def write(self, path, s):
        return write_acronym(path, s, AcronymObject(file="a.obj"))

    def read(self, path):
        return grasp_poses(self.raw(path), "acronym")

    def raw(self, path):
        with h5py.File(path) as file:
            return file["grasps/transforms"][()]


class GraspGen(Acronym):
    def write(self, path, s):
        return write_graspgen(path, s, file="a.obj")

    def raw(self, path):
        return np.array(json.loads(path.read_text())["grasps"]["transforms"])


class IsaacGrasp:
    rounding = 1e-14
    approach, closing = 2, 1
    tip = (0, 0, TIP)

    def write(self, path, s):
        return write_isaac_grasp(path, s, object_frame="a")

    def read(self, path):
        return grasp_poses(self.raw(path), "panda_hand")

    def raw(self, path):
        rows = YAML(typ="safe").load(path)["grasps"].values()
        q = [[*r["orientation"]["xyz"], r["orientation"]["w"]] for r in rows]
        R = Rotation.from_quat(q).as_matrix()
        return se3.from_rt(R, np.array([r["position"] for r in rows]))


class GraspGroupNpy:
    rounding = 1e-6
    approach, closing = 0, 1
    tip = (0.02 + TIP - MOUNT, 0, 0)  # GraspNet's own fingers end at x = depth = 0.02

    def write(self, path, s):
        return write_grasp_group(path, grasp_group([s], {s.instance: np.eye(4)}))

    def read(self, path):
        return read_grasp_group(path).Ts_a_grasp

    def raw(self, path):
        rows = np.load(path).astype(float)
        return se3.from_rt(rows[:, 4:13].reshape(-1, 3, 3), rows[:, 13:16])


class GraspitHdf5:
    """Written here as the paper's authors write it: each grasp beside its half turn."""

    rounding = 0.0
    approach, closing = 2, 1
    tip = (0, 0, TIP - MOUNT)

    def write(self, path, s):
        Ts = s.Ts_obj_grasp[executed(s)]
        with h5py.File(path, "w") as file:
            file["a"] = np.stack([Ts, Ts @ np.diag([-1.0, -1.0, 1.0, 1.0])], axis=1)
        return path

    def read(self, path):
        return read_grasp_file(path)["a"][:, 0]

    def raw(self, path):
        with h5py.File(path) as file:
            return file["a"][:, 0]


FORMATS = [Acronym, GraspGen, IsaacGrasp, GraspGroupNpy, GraspitHdf5]


def read_acronym(path):
    """Return grasps (N, 4, 4), which are held (N,), and the mesh's scale of an ACRONYM file."""
    with h5py.File(path) as file:
        Ts = grasp_poses(file["grasps/transforms"][()], "acronym")
        held = file["grasps/qualities/flex/object_in_gripper"][()] == 1
        return Ts, held, float(file["object/scale"][()])
