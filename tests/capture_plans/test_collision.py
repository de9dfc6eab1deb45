"""Laws and known answers of the collision model."""

from dataclasses import replace

import numpy as np
import pytest

from given_plans import BENCH, calibrated
from realsim.geometry import se3
from realsim.interop import import_pinocchio
from realsim.robots.arm import UR5, UR5E, arm_of, find_arm
from realsim.robots.coal_geometry import pinocchio_model
from realsim.robots.kinematics import DhChain
from realsim.robots.shapes import Box, Mount, Shape, WorkCell, link_placements
from realsim_capture_plans.collision.model import GROUPS, CollisionModel, interpolate
from realsim_capture_plans.collision.mount import camera_shape, d405_mount
from refusals import refused

INF = np.inf
EVERYWHERE = Box(lower=(-INF, -INF, -INF), upper=(INF, INF, 0.0))
LAMP = Box(lower=(0.1, 0.5, 0.6), upper=(0.3, 0.9, 1.4))
CELL = replace(BENCH, obstacles=(("lamp", LAMP),))
HOME = np.radians([0.0, -90.0, 90.0, -90.0, -90.0, 0.0])


def joints(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-np.pi, np.pi, (n, 6))


def model(chain: DhChain = UR5, mount: Mount | None = None, cell: WorkCell = CELL):
    return CollisionModel(chain, mount or d405_mount(), cell, 0.01)


def piece(kind: str, size: tuple[float, ...], at: list[float]) -> Shape:
    T = se3.from_translation(at)
    return Shape(part="bracket", frame=6, kind=kind, size_m=size, T_frame_shape=T)


@pytest.mark.parametrize("chain", [UR5E, calibrated(UR5, 1)], ids=["UR5e", "calibrated"])
def test_pinocchio_walks_the_same_chain(chain: DhChain) -> None:
    pin = import_pinocchio()

    walker, frames = pinocchio_model(chain)
    data = walker.createData()
    for q in joints(50):
        pin.forwardKinematics(walker, data, q)
        for i, T in enumerate(chain.link_frames(q)):
            assert np.abs(data.oMi[i].homogeneous @ frames[i] - T).max() < 1e-12


def test_free_is_clearance_above_the_margin() -> None:
    asked = model(UR5E)
    q = joints(800)
    clearance = asked.clearance(q)
    least = np.min([clearance[g] for g in GROUPS], axis=0)
    free = asked.free(q)
    unclear = np.abs(least - 0.01) < 1e-5
    assert np.array_equal(free[~unclear], (least >= 0.01)[~unclear])
    assert 0.1 < np.mean(free) < 0.4
    assert unclear.sum() < 5


def test_turning_arm_and_cell_together_changes_nothing() -> None:
    quarter = se3.exp_so3([0.0, 0.0, np.pi / 2])

    def turned(box: Box) -> Box:
        ends = np.nan_to_num(np.array([box.lower, box.upper]), posinf=4, neginf=-4) @ quarter.T
        return Box(lower=tuple(ends.min(0).tolist()), upper=tuple(ends.max(0).tolist()))

    table, keep_out, lamp = (turned(box) for box in (CELL.table, CELL.keep_out, LAMP))
    there = WorkCell(table=table, keep_out=keep_out, obstacles=(("lamp", lamp),))
    q = joints(200, 3)
    before = model().clearance(q)
    after = model(cell=there).clearance(q + np.eye(6)[0] * np.pi / 2)
    whole = model().clearance(q + 2 * np.pi * np.array([1, -1, 0, 1, -1, 1]))
    for group in GROUPS:
        outside = before[group] > 0  # EPA's depth is exact to its own tolerance only
        assert np.abs(before[group] - whole[group])[outside].max() < 1e-5
        if group in ("table", "scene"):  # the foot with its cable does not turn along
            assert np.abs(before[group] - after[group])[outside].max() < 1e-5
            assert np.array_equal(before[group] > 0, after[group] > 0)


def lowest(shape: Shape, T: np.ndarray) -> np.ndarray:
    """Least z of a shape at poses (N, 4, 4) of its frame, by its support function."""
    at = T @ shape.T_frame_shape
    up, z = at[:, 2, :3], at[:, 2, 3]
    if shape.kind == "box":
        return z - np.abs(up) @ (np.array(shape.size_m) / 2)
    radius, length = shape.size_m
    across = np.sqrt(np.maximum(0, 1 - up[:, 2] ** 2))
    return z - np.abs(up[:, 2]) * length / 2 - radius * (across if shape.kind == "cylinder" else 1)


def test_height_above_a_table_is_the_lowest_point() -> None:
    depth = 0.5
    table = replace(EVERYWHERE, upper=(INF, INF, -depth))
    cell = WorkCell(table=table, keep_out=Box(lower=(3, 3, 3), upper=(4, 4, 4)))
    mount, q = d405_mount(), joints(400, 5)
    frames = UR5.link_frames(q)
    shapes = [s for s in arm_of(UR5).shapes if s.frame >= 2] + [camera_shape(mount), *mount.bracket]
    low = np.min([lowest(s, frames[:, s.frame]) for s in shapes], axis=0)
    found = model(mount=mount, cell=cell).clearance(q)["table"]
    hanging = (low < 0) & (low > -depth)  # else shoulder and base, which never change, are lowest
    assert hanging.sum() > 50
    assert np.abs(found - (low + depth))[hanging].max() < 1e-5


def test_edges_are_free_where_every_step_is() -> None:
    asked = model()
    free = joints(600)[asked.free(joints(600))][:60]
    start, end = free[:-1], free[1:]
    samples, owner = interpolate(start, end, 0.05)
    expected = np.bincount(owner, weights=~asked.free(samples), minlength=len(start)) == 0
    found = asked.edges_free(start, end, 0.05)
    assert np.array_equal(found, expected)
    assert asked.edges_free(free, free + 0.002, 0.05).sum() > 50
    assert not found.all()
    assert asked.edges_free(free[0], free[0], 0.05).tolist() == [True]
    refused("59 starts and 60 goals", asked.edges_free, start, free, 0.05)


def test_fixed_pairs_are_not_in_the_clearances() -> None:
    pairs = {frozenset(p[1:]) for p in model().pairs}
    kept_out = ["camera-wrist 3", "bracket-wrist 3", "shoulder-table", "base-table"]
    kept_out += ["forearm-upper arm", "wrist 1-wrist 3"]
    assert not [p for p in kept_out if frozenset(p.split("-")) in pairs]
    needed = ["forearm-wrist 2", "forearm-camera", "upper arm-table", "base-wrist 1"]
    needed += ["bracket-lamp", "camera-lamp"]
    assert not [p for p in needed if frozenset(p.split("-")) not in pairs]
    assert frozenset(("camera", "keep-out box")) in pairs
    clearance = model().clearance(joints(500))
    assert all(np.ptp(clearance[g]) > 0.05 for g in GROUPS)
    # The camera's near corner is 44 mm off the axis and 15.7 mm before the flange; 38 mm radius.
    assert model().mount_gap_m == pytest.approx(np.hypot(0.006, 0.0157), abs=2e-4)


MOUNTS = {
    "camera .* inside the wrist 3": d405_mount(se3.from_translation([0.0, 0.0, -0.02])),
    "bracket .* inside the wrist 3.*flange's face": replace(
        d405_mount(), bracket=(piece("box", (0.02, 0.02, 0.02), [0.0, 0.0, 0.0]),)
    ),
    "bracket .* wrist 2 at every angle": replace(
        d405_mount(),
        bracket=tuple(
            piece("box", size, at)
            for side in (-0.0475, 0.0475)
            for size, at in (
                ((0.1, 0.006, 0.15), [0.0, side, -0.075]),
                ((0.006, 0.1, 0.15), [side, 0.0, -0.075]),
            )
        ),
    ),
}  # fmt: skip


@pytest.mark.parametrize("says", MOUNTS)
def test_a_mount_that_runs_into_the_wrist_is_named(says: str) -> None:
    refused(says, model, mount=MOUNTS[says])


@pytest.mark.parametrize(("arm", "link"), [("panda", "flange"), ("iiwa14", "link 7")])
def test_a_camera_inside_another_arms_wrist_is_named(arm: str, link: str) -> None:
    inside = d405_mount(se3.from_translation([0.0, 0.0, -0.02]))
    refused(f"camera .* mm inside the {link}.*T_ee_cam", model, find_arm(arm).chain, inside)


def test_a_table_through_the_shoulder_is_named() -> None:
    high = replace(CELL, table=replace(EVERYWHERE, upper=(INF, INF, 0.06)))
    refused(r"'table' is inside the arm's shoulder.*by 36 mm", model, cell=high)
    beside = replace(CELL, table=Box(lower=(0.3, -0.8, -INF), upper=(1.0, 0.8, 0.06)))
    assert model(cell=beside).free(HOME[None])[0]


def test_a_cell_in_millimetres_and_an_unknown_arm_are_named() -> None:
    far = replace(CELL, obstacles=(("wall", Box(lower=(700, 0, 0), upper=(750, 900, 900))),))
    refused(r"'wall'.*millimetres", model, cell=far)
    refused(r"no arm 'UR16e'\. There are: .*ur5, ur5e", model, replace(UR5, name="UR16e"))
    refused("called 'UR5' but its nominal", model, replace(UR5E, name="UR5"))
    refused("camera 'D999'", model, mount=replace(d405_mount(), camera="D999", bracket=()))
    refused("clearance_m", CollisionModel, UR5, d405_mount(), CELL, -0.01)


# --- Links on a calibrated chain whose DH frames lie tens of metres away are where they are.


def chain_through(axes: list[tuple[np.ndarray, np.ndarray]]) -> DhChain:
    """The UR5 whose joint axes 1-6 at zero are these lines (point, direction), in DH numbers.

    Standard DH leaves no choice: x_i is along the common normal of axes i and i + 1, however far
    away that is. The flange keeps its nominal place on axis 6.
    """
    nominal = UR5.link_frames(np.zeros(6))
    numbers = {name: getattr(UR5, name).copy() for name in ("theta", "d", "a", "alpha")}
    o, x, z = np.zeros(3), np.array([1.0, 0, 0]), axes[0][1]
    for i in range(5):
        p, z_next = axes[i + 1]
        normal = np.cross(z, z_next)
        normal *= (np.sign(normal @ nominal[i + 1][:3, 0]) or 1.0) / np.linalg.norm(normal)
        # Feet of the common normal: o + d z + a normal = p + s z_next.
        d, a, _ = np.linalg.solve(np.stack([z, normal, -z_next], axis=-1), p - o)
        theta = np.arctan2(np.cross(x, normal) @ z, x @ normal)
        alpha = np.arctan2(np.cross(z, z_next) @ normal, z @ z_next)
        for name, value in (("theta", theta), ("d", d), ("a", a), ("alpha", alpha)):
            numbers[name][i] = value
        o, x, z = o + d * z + a * normal, normal, z_next
    flange = nominal[6]
    numbers["d"][5] = (flange[:3, 3] - o) @ z
    numbers["theta"][5] = np.arctan2(np.cross(x, flange[:3, 0]) @ z, x @ flange[:3, 0])
    return replace(UR5, **{f"delta_{name}": numbers[name] - getattr(UR5, name) for name in numbers})


def factory_arm(seed: int, tilt_rad: float = 2e-4, shift_m: float = 3e-4) -> DhChain:
    """A UR5 as machined: every joint axis off by a fraction of a millimetre and a milliradian."""
    rng = np.random.default_rng(seed)
    axes: list[tuple[np.ndarray, np.ndarray]] = []
    for i, T in enumerate(UR5.link_frames(np.zeros(6))[:6]):
        by = rng.normal(0, tilt_rad, 3) if i else np.zeros(3)
        axes.append((T[:3, 3] + rng.normal(0, shift_m, 3) * (i > 0), se3.exp_so3(by) @ T[:3, 2]))
    return chain_through(axes)


ARMS = [factory_arm(seed) for seed in range(3)]


def test_links_stay_within_millimetres_of_the_nominal_ones() -> None:
    arm = max(ARMS, key=lambda a: np.abs(a.delta_d).max())
    placements = link_placements(arm_of(arm))
    q = np.random.default_rng(9).uniform(-np.pi, np.pi, (300, 6))
    at = arm.link_frames(q) @ placements
    nominal = UR5.link_frames(q)
    assert np.linalg.norm((at - nominal)[..., :3, 3], axis=-1).max() < 4e-3
    assert se3.angle(np.swapaxes(at, -1, -2)[..., :3, :3] @ nominal[..., :3, :3]).max() < 5e-3
    assert np.array_equal(placements[6], np.eye(4))  # the camera follows the calibrated flange
    assert np.linalg.norm((arm.link_frames(q) - nominal)[:, 2, :3, 3], axis=-1).min() > 0.9


def test_clearances_change_by_millimetres_only() -> None:
    q = joints(200, 3)
    nominal, real = model(cell=BENCH), model(ARMS[0], cell=BENCH)
    assert real.pairs == nominal.pairs
    before, after = nominal.clearance(q), real.clearance(q)
    for group in GROUPS:
        assert np.abs(before[group] - after[group]).max() < 8e-3
    assert np.array_equal(real.free(q), np.min([after[g] for g in GROUPS], axis=0) >= 0.01)


def test_another_arms_calibration_is_refused() -> None:
    other = replace(UR5, delta_a=np.array([0.0, -0.187, -0.18, 0.0, 0.0, 0.0]))
    refused(r"moves the forearm of a nominal UR5 by up to \d+ mm", model, other, cell=BENCH)
    uncancelled = replace(UR5, delta_d=np.array([0.0, 11.198, -92.527, 0.0, 0.0, 0.0]))
    refused("calibration file another arm's", link_placements, arm_of(uncancelled))
