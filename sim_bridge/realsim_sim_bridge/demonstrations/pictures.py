"""Pictures of a step: table, objects and arm, rendered by the embedded renderer when asked for."""

import warnings
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial import ConvexHull

from realsim.arrays import Array, Int32
from realsim.geometry import se3
from realsim.geometry.mesh import BOX_FACES, slab_mesh
from realsim.geometry.mesh_files import load_mesh
from realsim.models.simplify import colors_at, simplified
from realsim.records import Mesh
from realsim.rendering.moving_scene import Moment, MovingPicture, MovingScene, Seen
from realsim.rendering.photo import Lighting
from realsim.rendering.rays import BACKGROUND, PlacedMesh
from realsim.robots.arm import RobotArm, find_arm
from realsim.robots.hand import FRANKA, Hand
from realsim.robots.shapes import LARGEST_MM_SCALE
from realsim_sim_bridge.arm.grasping_arm import GraspingArm, solid_points
from realsim_sim_bridge.demonstrations.attempt_motion import AttemptMotion
from realsim_sim_bridge.demonstrations.records import DemonstrationCamera

# --- What arm and hand look like: an arm as its own meshes, drawn with few triangles, or as its
# bodies; a hand as its boxes, but for Franka's, whose meshes come with PyBullet.


LINK_FACES = 1500
"""Triangles of a link: at 320 x 240 none is seen, and a frame is prepared in 30 instead of 600
ms."""
WHITE, DARK = 235, 70
"""Grey levels of parts that come without colours: an arm's white lacquer, and a hand."""
FRANKA_MESH = "package://pybullet_data/franka_panda/meshes/visual/{}.obj"
FINGER_Z_M = 0.0584
"""Where the fingers' frame is along the axis of Franka's hand, from its mount (panda.urdf) [m]."""


def robot_meshes(
    arm: GraspingArm, joints_rad: Array, openings_m: Array, T_table_base: Array
) -> tuple[tuple[Mesh, ...], Array]:
    """Return what an arm and its hand are drawn as, and where that is.

    Args:
        arm: the arm with its hand.
        joints_rad: (S, n) [rad].
        openings_m: (S,) distance of the finger faces [m].
        T_table_base: (4, 4) [m].

    Returns:
        the meshes (L), the hand's last, and T_table_mesh (S, L, 4, 4).

    Raises:
        InputError: a mesh cannot be read.
        MissingLibraryError: the package with the meshes is not installed.
    """
    links, meshes = _arm_looks(arm.arm)
    frames = T_table_base @ arm.frames(joints_rad)
    hand, Ts = hand_meshes(arm.hand, frames[:, -1], openings_m)
    return (*meshes, *hand), np.concatenate([frames[:, list(links)], Ts], axis=1)


def hand_meshes(
    hand: Hand, Ts_table_grasp: Array, openings_m: Array
) -> tuple[tuple[Mesh, ...], Array]:
    """Return what a hand is drawn as (L), and T_table_mesh (S, L, 4, 4) at poses (S, 4, 4)."""
    meshes, sides = _hand_looks(hand)
    Ts = np.tile(Ts_table_grasp[:, None], (1, len(meshes), 1, 1))
    shift = np.zeros((len(openings_m), len(meshes), 3))
    shift[..., 1] = openings_m[:, None] / 2.0 * sides
    shift[..., 2] = hand.z_pad(openings_m)[:, None] * np.abs(sides)
    Ts[..., :3, 3] += np.einsum("sij,slj->sli", Ts_table_grasp[:, :3, :3], shift)
    return meshes, Ts


@lru_cache(maxsize=4)
def _arm_looks(arm: RobotArm) -> tuple[tuple[int, ...], tuple[Mesh, ...]]:
    """Return the links of an arm that are drawn, and their meshes in the links' frames."""
    found: dict[int, list[Mesh]] = {}
    for link, look in arm.looks:
        if look.file is not None:
            scale = np.array(look.size_m)
            unit = "mm" if np.abs(scale).max() < LARGEST_MM_SCALE else "m"
            mesh = _drawn(look.file, unit)
            points = mesh.vertices * scale * (1e3 if unit == "mm" else 1.0)
            found.setdefault(link, []).append(
                replace(mesh, vertices=se3.transform(look.T_link_shape, points))
            )
    for shape in arm.shapes:
        if not any(link == shape.frame for link, _ in arm.looks):
            hull = ConvexHull(solid_points(shape))
            found.setdefault(shape.frame, []).append(_grey(hull.points, _outwards(hull), WHITE))
    parts = [(link, mesh) for link, meshes in sorted(found.items()) for mesh in meshes]
    return tuple(link for link, _ in parts), tuple(mesh for _, mesh in parts)


@lru_cache(maxsize=4)
def _hand_looks(hand: Hand) -> tuple[tuple[Mesh, ...], Array]:
    """Return the meshes of a closed hand, frame `grasp`, and which finger (+1, -1) each is of."""
    if hand.name == FRANKA:
        folder = find_arm("panda").folder
        palm, finger = (
            _drawn(folder.file(FRANKA_MESH.format(name), "a mesh of Franka's hand"), "m")
            for name in ("hand", "finger")
        )
        mount = np.array([0.0, 0.0, hand.mount_z_m])
        other = finger.vertices * [-1.0, -1.0, 1.0]
        fingers = [
            replace(finger, vertices=points + mount + [0.0, 0.0, FINGER_Z_M])
            for points in (finger.vertices, other)
        ]
        sides = np.array([0.0, 1.0, -1.0])
        return (replace(palm, vertices=palm.vertices + mount), *fingers), sides
    boxes, palms, side = hand.boxes(0.0)[0], len(hand.palm_boxes), hand.side_boxes
    parts: list[tuple[Array, float]] = [(box, 0.0) for box in boxes[:palms]]
    for first, sign in ((palms, -1.0), (palms + side, 1.0)):
        parts += [(box, sign) for box in boxes[first : first + len(hand.finger_boxes)]]
    meshes = [
        _grey(np.array(list(product(*zip(*box, strict=True)))), BOX_FACES, DARK) for box, _ in parts
    ]
    return tuple(meshes), np.array([sign for _, sign in parts])


def _drawn(path: Path, unit: Literal["m", "mm"]) -> Mesh:
    """Return a mesh with few triangles and colours."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # colours that some files name are not there
        mesh = simplified(load_mesh(path, unit), LINK_FACES)
    colors = colors_at(mesh, mesh.vertices) if mesh.texture is not None else mesh.colors
    if colors is None:
        return _grey(mesh.vertices, mesh.faces, WHITE)
    return Mesh(vertices=mesh.vertices, faces=mesh.faces, colors=colors)


def _grey(vertices: Array, faces: Int32, level: int) -> Mesh:
    """Return a mesh of one grey."""
    colors = np.full((len(vertices), 3), level, np.uint8)
    return Mesh(vertices=vertices, faces=faces, colors=colors)


def _outwards(hull: ConvexHull) -> Int32:
    """Return the triangles of a hull, corners counter-clockwise seen from outside."""
    a, b, c = (hull.points[hull.simplices[:, k]] for k in range(3))
    inwards = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces = hull.simplices.astype(np.int32)
    faces[inwards] = faces[inwards][:, ::-1]
    return faces


TABLE_M, TABLE_THICKNESS_M = 1.8, 0.03
"""Edge and thickness of the drawn table [m]: a robot's table."""
MOST_FACES, FEWER_FACES = 20_000, 10_000
"""Meshes with more triangles than the first are drawn with the second: every frame prepares all."""
TEXTURE_PX = 512
"""Largest edge of a texture that is drawn: a model of 4096 px costs a second a frame."""
LIGHTING = Lighting(gamma=2.2, samples=2, psf_px=0.4)
"""As a monitor shows it; four rays at edges, since the video's colours are coarser than that."""


class ScenePictures:
    """The pictures of a scene with its arm; what does not change is prepared once."""

    def __init__(
        self,
        cameras: Mapping[str, DemonstrationCamera],
        objects: Mapping[int, tuple[Mesh, Array]],
        arm: GraspingArm,
        T_table_base: Array,
        middle_xy: tuple[float, float],
    ) -> None:
        """Keep what is needed; nothing is prepared yet.

        Args:
            cameras: by name.
            objects: mesh and T_table_obj (4, 4) [m] where it stands at first, by instance.
            arm: the arm with its hand.
            T_table_base: (4, 4) [m].
            middle_xy: middle of the scene on the table [m].
        """
        self.cameras, self._objects, self._arm = cameras, objects, arm
        self.T_table_base, self.middle_xy = T_table_base, np.array(middle_xy)
        self._known: tuple[MovingScene, dict[int, int], int] | None = None

    def scene(self) -> tuple[MovingScene, dict[int, int], int]:
        """Return the scene, the number of each instance in it, and that of the arm's first mesh.

        Raises:
            InputError: a mesh of the arm cannot be read.
            MissingLibraryError: the package with the meshes is not installed.
        """
        if self._known is None:
            table = np.eye(4)
            table[:2, 3] = self.middle_xy
            placed = [PlacedMesh(BACKGROUND, slab_mesh(TABLE_M, TABLE_THICKNESS_M), table)]
            numbers = {i: 1 + k for k, i in enumerate(sorted(self._objects))}
            placed += [PlacedMesh(i, *self._objects[i]) for i in numbers]
            zero = np.zeros((1, len(self._arm.arm.joint_names)))
            meshes, Ts = self.robot(zero, np.zeros(1))
            placed += [PlacedMesh(BACKGROUND, m, T) for m, T in zip(meshes, Ts[0], strict=True)]
            self._known = MovingScene(placed, LIGHTING), numbers, 1 + len(numbers)
        return self._known

    def robot(self, joints_rad: Array, openings_m: Array) -> tuple[tuple[Mesh, ...], Array]:
        """Return arm and hand (L), and T_table_mesh (S, L, 4, 4); see `robot_meshes`."""
        return robot_meshes(self._arm, joints_rad, openings_m, self.T_table_base)


class AttemptPictures:
    """The pictures of one attempt, step by step."""

    def __init__(self, scene: ScenePictures, instance: int, motion: AttemptMotion) -> None:
        """Keep what moves; nothing is rendered yet.

        Args:
            scene: the scene.
            instance: the object that is grasped.
            motion: of the arm and the object.
        """
        self._scene, self._instance, self._motion = scene, instance, motion
        self._Ts_robot: Array | None = None
        self._stills: dict[str, Seen] = {}
        self._now: tuple[int, Moment] | None = None
        self._last: dict[str, tuple[int, MovingPicture]] = {}

    def picture(self, step: int, name: str) -> MovingPicture:
        """Return what a camera sees at a step; asked again at once, it is not rendered again.

        Raises:
            KeyError: there is no camera of that name.
        """
        camera = self._scene.cameras[name]
        if self._last.get(name, (-1,))[0] != step:
            self._last[name] = step, self._rendered(step, camera)
        return self._last[name][1]

    def T_table_cam(self, step: int, name: str) -> Array:
        """Return where a camera is at a step (4, 4) [m]."""
        camera = self._scene.cameras[name]
        if not camera.on_hand:
            return camera.T_frame_cam
        return self._scene.T_table_base @ self._motion.Ts_base_ee[step] @ camera.T_frame_cam

    def _rendered(self, step: int, camera: DemonstrationCamera) -> MovingPicture:
        scene, numbers, first = self._scene.scene()
        if self._Ts_robot is None:
            self._Ts_robot = self._scene.robot(self._motion.joints_rad, self._motion.opening_m)[1]
        if self._now is None or self._now[0] != step:
            poses = {first + k: T for k, T in enumerate(self._Ts_robot[step])}
            poses[numbers[self._instance]] = self._motion.Ts_table_obj[step]
            self._now = step, scene.moment(poses)
        moment = self._now[1]
        if camera.on_hand:
            return scene.picture(moment, camera.intrinsics, self.T_table_cam(step, camera.name))
        if camera.name not in self._stills:
            resting = [0, *(n for i, n in numbers.items() if i != self._instance)]
            self._stills[camera.name] = scene.still(camera.intrinsics, camera.T_frame_cam, resting)
        return scene.renewed(moment, self._stills[camera.name])


def drawn_mesh(mesh: Mesh) -> Mesh:
    """Return an object's mesh as small pictures need it."""
    import cv2

    if len(mesh.faces) > MOST_FACES:
        return simplified(mesh, FEWER_FACES)
    if mesh.texture is None or max(mesh.texture.shape[:2]) <= TEXTURE_PX:
        return mesh
    scale = TEXTURE_PX / max(mesh.texture.shape[:2])
    size = [max(1, round(scale * edge)) for edge in mesh.texture.shape[1::-1]]
    texture = cv2.resize(mesh.texture, size, interpolation=cv2.INTER_AREA)
    return replace(mesh, texture=np.asarray(texture, np.uint8))
