"""The chain of hinges in an MJCF, and the shapes of its bodies; MuJoCo itself reads the file."""

from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.interop import import_extra
from realsim.robots.robot_files import RobotFolder
from realsim.robots.urdf import UrdfChain, UrdfShape, onto_z


def read_mjcf_chain(folder: RobotFolder, file: str, base: str, flange: str) -> UrdfChain:
    """Return the chain between two bodies of an MJCF.

    Args:
        folder: the robot's.
        file: as `robot.toml` names the MJCF.
        base: body that the robot is bolted down with.
        flange: body or site that tools are bolted to, z out of it.

    Raises:
        InputError: MuJoCo refuses the file, no such bodies, or a joint that is no hinge.
        MissingLibraryError: MuJoCo is not installed.
    """
    module = import_extra(
        "mujoco", "mujoco", f"{folder.path}, which is described by an MJCF,",
        "A URDF is read without it.",
    )  # fmt: skip
    path = folder.file(file, "the MJCF")
    try:
        model = module.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise InputError(f"MuJoCo cannot read {path}: {str(error).strip()[:400]}") from error
    return _Reader(module, model, path).chain(base, flange)


class _Reader:
    def __init__(self, module: Any, model: Any, path: Path) -> None:
        self._mujoco, self._model, self._path = module, model, path

    def chain(self, base: str, flange: str) -> UrdfChain:
        model = self._model
        end, T_end = self._end(flange)
        first = self._id("BODY", base)
        if first < 0:
            raise InputError(f"{self._path} has no body '{base[:60]}'; it has: {self._names()}.")
        bodies = [end]
        while bodies[0] != first:
            if bodies[0] == 0:
                raise InputError(
                    f"{self._path}: the flange '{flange}' does not hang on the base '{base}'."
                )
            bodies.insert(0, int(model.body_parentid[bodies[0]]))
        steps: list[Array] = []
        names: list[str] = []
        rows: list[Array] = []
        shapes: list[list[tuple[bool, UrdfShape]]] = [self._shapes(first, np.eye(4))]
        T = np.eye(4)
        for body in bodies[1:]:
            T = T @ _pose(model.body_pos[body], model.body_quat[body])
            start, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
            for joint in range(start, start + count):
                T_body_joint = self._hinge(joint)
                steps.append(T @ T_body_joint)
                names.append(self._mujoco.mj_id2name(model, self._kind("JOINT"), joint) or "")
                rows.append(self._limits(joint))
                # The body stands as drawn where the joint is at its reference.
                still = se3.exp_so3([0.0, 0.0, -float(model.qpos0[model.jnt_qposadr[joint]])])
                T = se3.from_rt(still, np.zeros(3)) @ se3.invert(T_body_joint)
                shapes.append([])
            shapes[-1] += self._shapes(body, T)
        steps.append(T @ T_end)
        if not rows:
            raise InputError(f"{self._path}: no hinge turns between '{base}' and '{flange}'.")
        lower, upper = np.stack(rows, axis=1)
        unknown = np.full(len(rows), np.nan)
        return UrdfChain(
            joint_names=tuple(names), steps=np.stack(steps), lower=lower, upper=upper,
            speed=unknown, torque=unknown,
            collision=tuple(tuple(s for hits, s in body if hits) for body in shapes),
            visual=tuple(tuple(s for hits, s in body if not hits) for body in shapes),
            mass_kg=float(sum(model.body_mass[body] for body in bodies)),
        )  # fmt: skip

    def _end(self, flange: str) -> tuple[int, Array]:
        """Return the body that the flange is on, and the flange in it."""
        body, site = self._id("BODY", flange), self._id("SITE", flange)
        if body >= 0:
            return body, np.eye(4)
        if site < 0:
            raise InputError(
                f"{self._path} has no body or site '{flange[:60]}'; it has: {self._names()}."
            )
        model = self._model
        return int(model.site_bodyid[site]), _pose(model.site_pos[site], model.site_quat[site])

    def _hinge(self, joint: int) -> Array:
        """Return the joint's frame, z its axis, in its body."""
        model = self._model
        if model.jnt_type[joint] != int(self._mujoco.mjtJoint.mjJNT_HINGE):
            name = self._mujoco.mj_id2name(model, self._kind("JOINT"), joint)
            raise InputError(f"{self._path}: the joint '{name}' is no hinge; an arm's joints turn.")
        at = se3.from_translation(np.array(model.jnt_pos[joint]))
        return at @ onto_z(np.array(model.jnt_axis[joint]))

    def _limits(self, joint: int) -> Array:
        if not self._model.jnt_limited[joint]:
            return np.array([-np.inf, np.inf])
        return np.array(self._model.jnt_range[joint])

    def _shapes(self, body: int, T: Array) -> list[tuple[bool, UrdfShape]]:
        """Return a body's shapes and whether each of them collides."""
        model, kinds = self._model, self._mujoco.mjtGeom
        start, count = int(model.body_geomadr[body]), int(model.body_geomnum[body])
        found: list[tuple[bool, UrdfShape]] = []
        for geom in range(start, start + count):
            kind, size = int(model.geom_type[geom]), model.geom_size[geom]
            T_geom = T @ _pose(model.geom_pos[geom], model.geom_quat[geom])
            points, word, lengths = None, "", tuple[float, ...]()
            if kind == int(kinds.mjGEOM_BOX):
                word, lengths = "box", tuple((2 * size).tolist())
            elif kind == int(kinds.mjGEOM_SPHERE):
                word, lengths = "sphere", (float(size[0]),)
            elif kind in (int(kinds.mjGEOM_CYLINDER), int(kinds.mjGEOM_CAPSULE)):
                word = "cylinder" if kind == int(kinds.mjGEOM_CYLINDER) else "capsule"
                lengths = (float(size[0]), 2 * float(size[1]))
            elif kind == int(kinds.mjGEOM_MESH):
                mesh = int(model.geom_dataid[geom])
                first, many = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
                word, points = "mesh", np.array(model.mesh_vert[first : first + many], np.float64)
            else:
                continue
            collides = bool(model.geom_contype[geom] or model.geom_conaffinity[geom])
            name = self._mujoco.mj_id2name(model, self._kind("BODY"), body) or ""
            found.append((collides, UrdfShape(word, lengths, T_geom, None, name, points)))
        return found

    def _kind(self, word: str) -> int:
        return int(getattr(self._mujoco.mjtObj, f"mjOBJ_{word}"))

    def _id(self, word: str, name: str) -> int:
        return int(self._mujoco.mj_name2id(self._model, self._kind(word), name))

    def _names(self) -> str:
        count = int(self._model.nbody)
        names = (self._mujoco.mj_id2name(self._model, self._kind("BODY"), k) for k in range(count))
        return ", ".join(str(n) for n in names)[:600]


def _pose(position: Array, quaternion_wxyz: Array) -> Array:
    R = se3.from_quaternion_wxyz(np.array(quaternion_wxyz, dtype=np.float64))
    return se3.from_rt(R, np.array(position, dtype=np.float64))
