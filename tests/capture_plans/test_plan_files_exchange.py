"""Laws of importers and exporters: what is written can be read back; what is not said is proven.

Laws of plan files: what is written comes back, and what was mixed up is named.
"""

import json
import os
import re
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bop_scenes import edit
from given_plans import CENTER, HOME, MOUNT, a_plan
from realsim.errors import InputError, RealsimError, UnitError
from realsim.formats.graspnet.cameras import read_camera_poses
from realsim.geometry import se3
from realsim.robots.arm import UR5, UR5E, find_arm
from realsim.robots.kinematics import DhChain
from realsim.robots.shapes import Box
from realsim_capture_plans.collision.mount import d405_mount
from realsim_capture_plans.plan_files import plan_json
from realsim_capture_plans.plan_files.foreign_plans import (
    colliding_legs,
    export_csv,
    export_graspnet,
    export_urscript,
    plan_of_path,
    table_frame,
)
from realsim_capture_plans.plan_files.joint_paths import read_path
from realsim_capture_plans.plan_files.plan_json import load_plan, plan_to_json, save_plan
from realsim_capture_plans.planning.ordering import move_seconds
from realsim_capture_plans.planning.record import (
    CapturePlan,
    PlanConfig,
    hash_of,
    plan_content,
    plan_of,
)
from refusals import refused

REAL = Path(os.environ.get("REALSIM_DATA", "../shared/data")) / "motion" / "koch_ur5_paths"


def write_path(
    path: Path,
    chain: DhChain,
    *,
    degrees: bool = True,
    scale: float = 1.0,
    tool: np.ndarray | None = None,
) -> np.ndarray:
    """A path file with tool poses; returns its joints [rad]."""
    q = HOME + np.random.default_rng(1).normal(0, 0.4, (12, 6))
    T = chain.forward(q) @ (np.eye(4) if tool is None else tool)
    rows = [[*(scale * t[:3, 3]), *se3.log_so3(t[:3, :3])] for t in T]
    poses = [dict(zip("xyzabc", row, strict=True)) for row in rows]
    joints = (np.degrees(q) if degrees else q).tolist()
    data = {"joints": joints, "cart_pose": poses, "via_points": ["1", "1", *["0"] * 9, "1"]}
    path.write_text(json.dumps(data))
    return q


def imported(path: Path, chain: DhChain | None = None, **options: Any) -> CapturePlan:
    """The plan of a file, for the arm that its tool poses prove where none is given."""
    found = read_path(path, chain)
    if chain is None:
        assert found.reading is not None
        chain = found.reading.chain
    settings = {"mount": MOUNT, "config": PlanConfig(), "center": CENTER} | options
    return plan_of_path(found, chain=chain, **settings)


# --- out and back ----------------------------------------------------------------------------


def test_csv_comes_back_bit_for_bit(tmp_path: Path) -> None:
    plan = a_plan()
    export_csv(plan, tmp_path / "p.csv")
    back = imported(tmp_path / "p.csv", UR5, config=plan.config)
    assert back.kind == "imported"
    for name in ("home", "joints", "Ts_base_cam"):
        assert np.array_equal(getattr(back, name), getattr(plan, name)), name
    for k in range(len(plan)):
        assert np.array_equal(back.move(k), plan.move(k))
    # The expected camera poses of the table itself.
    found = read_path(tmp_path / "p.csv", UR5)
    assert found.Ts_base_cam is not None
    assert np.abs(found.Ts_base_cam[~found.via] - plan.Ts_base_cam).max() < 1e-12
    assert np.all(np.isnan(found.Ts_base_cam[found.via]))


def test_csv_of_another_robot_or_mount_is_named(tmp_path: Path) -> None:
    export_csv(a_plan(), tmp_path / "p.csv")
    refused("mm from those of this robot", imported, tmp_path / "p.csv", UR5E)
    other = d405_mount(se3.from_translation([0.0, 0.065, 0.035]))
    refused("mm from those of this robot", imported, tmp_path / "p.csv", UR5, mount=other)
    assert read_path(tmp_path / "p.csv", None).reading is None


def test_urscript_drives_the_same_corners_and_nothing_else(tmp_path: Path) -> None:
    plan = a_plan()
    export_urscript(plan, tmp_path / "p.script")
    text = (tmp_path / "p.script").read_text()
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    assert plan.content_hash in text and "UR5" in text and plan.mount.name in text
    assert lines[0] == "def realsim_plan():" and lines[-1] == "end"
    # Every block that is opened is closed.
    opened = sum(bool(re.match(r"\s*(def|while|if)\b", line)) for line in lines)
    assert opened == sum(line.strip() == "end" for line in lines)
    moves = re.findall(r"movej\(\[(.*?)\], a=([\d.]+), v=([\d.]+)\)", text)
    q = np.array([[float(v) for v in m[0].split(",")] for m in moves])
    corners = np.concatenate([plan.move(k)[1:] for k in range(len(plan))])
    assert q.shape == corners.shape and np.abs(q - corners).max() < 1e-12
    assert {(float(a), float(v)) for _, a, v in moves} == {(1.4, 1.05)}
    home = re.search(r"home = \[(.*?)\]", text)
    assert home is not None
    assert np.abs(np.array([float(v) for v in home[1].split(",")]) - plan.home).max() < 1e-12
    # The motion stops at every view: settled, then announced, in order; nothing is blended.
    views = re.findall(r'sleep\(([\d.]+)\)\n  textmsg\("realsim view ", (\d+)\)', text)
    assert [int(k) for _, k in views] == list(range(len(plan)))
    assert "r=" not in text and "e-" not in "".join(m[0] for m in moves)


def test_a_seven_joint_plan_goes_out_and_comes_back(tmp_path: Path) -> None:
    arm = find_arm("panda")
    joints = arm.home + np.random.default_rng(0).normal(0, 0.1, (9, 7))
    plan = replace(a_plan(), chain=arm.chain, home=arm.home, vias=(), joints=joints)
    save_plan(plan, tmp_path / "p.json")
    assert load_plan(tmp_path / "p.json").content_hash == plan.content_hash
    export_csv(plan, tmp_path / "p.csv")
    back = imported(tmp_path / "p.csv", plan.chain)
    assert np.array_equal(back.joints, plan.joints) and np.array_equal(back.home, plan.home)
    refused(r"7 joint angles in a row, and a UR5 has 6.*Panda", imported, tmp_path / "p.csv", UR5)
    with pytest.raises(InputError, match=r"URScript drives Universal.*Panda.*\.csv"):
        export_urscript(plan, tmp_path / "p.script")
    # Only a flange that stands off the last DH frame is written: files of a UR stay as they were.
    far = replace(arm.chain, T_n_ee=se3.from_translation([0.0, 0.0, 0.1]))
    content = plan_content(replace(plan, chain=far))
    assert "T_base_0" not in content["dh"] and "T_n_ee" not in plan_content(plan)["dh"]
    assert np.array_equal(plan_of(content).chain.T_n_ee, far.T_n_ee)


def test_graspnet_poses_come_back(tmp_path: Path) -> None:
    plan = a_plan()
    export_graspnet(plan, tmp_path / "g")
    poses = np.load(tmp_path / "g" / "camera_poses.npy")
    first = np.load(tmp_path / "g" / "cam0_wrt_table.npy")
    # graspnetAPI's convention: relative to the first frame, which is relative to the table.
    assert poses.shape == (len(plan), 4, 4) and first.shape == (4, 4)
    assert np.array_equal(poses[0], np.eye(4))
    T_base_table = table_frame(plan)
    assert np.abs(T_base_table @ first @ poses - plan.Ts_base_cam).max() < 1e-12
    assert np.abs(T_base_table @ read_camera_poses(tmp_path / "g") - plan.Ts_base_cam).max() < 1e-12
    assert np.array_equal(T_base_table, se3.from_translation([0.37, 0.02, -0.02]))
    assert load_plan(tmp_path / "g" / "plan.json").content_hash == plan.content_hash


# --- what a path does not say is proven from its poses ----------------------------------------


@pytest.mark.parametrize(
    ("chain", "degrees", "scale"), [(UR5, True, 1000.0), (UR5E, False, 1.0)], ids=["UR5", "UR5e"]
)
def test_robot_units_and_tool_are_found(
    chain: DhChain, degrees: bool, scale: float, tmp_path: Path
) -> None:
    tool = se3.exp([0.1, -0.2, 0.4, 0.01, 0.02, 0.2])
    q = write_path(tmp_path / "p.json", chain, degrees=degrees, scale=scale, tool=tool)
    found = read_path(tmp_path / "p.json", None).reading
    assert found is not None
    assert found.chain is chain and found.joint_unit == ("deg" if degrees else "rad")
    assert found.length_unit == ("m" if scale == 1.0 else "mm")
    assert np.abs(found.T_ee_tcp - tool).max() < 1e-9 and found.gap_m < 1e-9
    plan = imported(tmp_path / "p.json")
    assert plan.chain is chain and np.abs(plan.home - q[0]).max() < 1e-12
    assert np.abs(plan.joints - q[2:-1]).max() < 1e-12
    assert np.abs(plan.move(0) - q[:3]).max() < 1e-12
    assert plan.metrics["rows_after_last_view"] == 1
    assert plan.metrics["tool_offset_m"] == pytest.approx(np.linalg.norm(tool[:3, 3]))


def test_a_path_for_the_other_robot_is_refused_with_both_fits(tmp_path: Path) -> None:
    write_path(tmp_path / "p.json", UR5E)
    refused(r"fit a UR5e.*for a UR5 \d+ mm are left", imported, tmp_path / "p.json", UR5)


def test_a_claim_against_the_evidence_is_refused(tmp_path: Path) -> None:
    write_path(tmp_path / "p.json", UR5)
    refused("joints in deg", read_path, tmp_path / "p.json", UR5, "rad", error=UnitError)


def test_without_poses_the_unit_has_to_be_said(tmp_path: Path) -> None:
    q = write_path(tmp_path / "p.json", UR5)
    edit(tmp_path / "p.json", lambda data: data.pop("cart_pose"))
    refused("--joints-unit", read_path, tmp_path / "p.json", UR5, error=UnitError)
    assert np.abs(read_path(tmp_path / "p.json", UR5, "deg").joints - q).max() < 1e-12
    refused("look like degrees", read_path, tmp_path / "p.json", UR5, "rad", error=UnitError)


HEADER = ",".join(f"q{j}_{{u}}" for j in range(1, 7))
ROWS_DEG = ["10,-90,90,-100,-85,0", "20,-80,95,-110,-80,5", "15,-85,92,-105,-82,170"]
ROWS_RAD = ["0.1,-1.6,1.7,-1.7,-1.5,0.3", "0.2,-1.5,1.7,-1.7,-1.5,0.3"]


@pytest.mark.parametrize(
    ("text", "error", "says"),
    [
        ("\n".join(ROWS_RAD), InputError, "header with the columns q1_rad"),
        ("\n".join([HEADER.format(u="rad"), *ROWS_DEG]), UnitError, r"line 4, joint 6.* is 170"),
        ("\n".join([HEADER.format(u="deg"), *ROWS_RAD]), UnitError, "look like radians"),
        ("\n".join(["q1,q2,q3,q4,q5,q6", *ROWS_RAD]), UnitError, "do not say their unit"),
        ("\n".join([HEADER.format(u="rad"), "0,1,2,x,4,5"]), InputError, "line 2: q4_rad is 'x'"),
        ("\n".join(["via," + HEADER.format(u="deg"), "maybe," + ROWS_DEG[0]]), InputError, "maybe"),
        (
            "\n".join([HEADER.format(u="deg"), "0,-90,190,0,0,0", "0,-90,90,0,0,0"]), InputError,
            "elbow is 190.0 deg",
        ),
        (
            "\n".join([HEADER.format(u="deg").replace(",", ";"), "0,5;1;2;3;4;5"]), InputError,
            "Decimal commas",
        ),
    ],
)  # fmt: skip
def test_tables_that_cannot_be_right_are_named(
    text: str, error: type[Exception], says: str, tmp_path: Path
) -> None:
    (tmp_path / "p.csv").write_text(text)
    assert "p.csv" in refused(says, imported, tmp_path / "p.csv", UR5, error=error)


@pytest.mark.parametrize(("mark", "form"), [(";", "Q{j} [deg]"), ("\t", "q{j}(degrees)")])
def test_tables_of_other_programs_are_read(mark: str, form: str, tmp_path: Path) -> None:
    header = mark.join(["name", *(form.format(j=j) for j in range(1, 7)), "via"])
    rows = [mark.join(["a", *row.split(","), str(k % 2)]) for k, row in enumerate(ROWS_DEG)]
    (tmp_path / "p.csv").write_text("\ufeff" + "\r\n".join(["# a comment", header, *rows, ""]))
    found = read_path(tmp_path / "p.csv", UR5)
    assert np.abs(np.degrees(found.joints[2]) - [15, -85, 92, -105, -82, 170]).max() < 1e-12
    assert found.via.tolist() == [False, True, False] and found.rows[0] == "line 3"


def test_no_path_ends_in_a_traceback(tmp_path: Path) -> None:
    for text in ("[]", '{"joints": 3}', '{"joints": [[1]]}', '{"joints": [[0,0,0,0,0,0]]}', "{"):
        (tmp_path / "p.json").write_text(text)
        refused(r"p\.json", imported, tmp_path / "p.json", UR5)


# --- what is imported is checked ---------------------------------------------------------------


def test_colliding_moves_are_named_and_stay(tmp_path: Path) -> None:
    through = HOME + np.array([0.0, 0.9, -0.2, 0.0, 0.0, 0.0])  # the camera goes into the table

    def plan_of_rows(*joints: np.ndarray, **options: Any) -> CapturePlan:
        rows = [",".join(map(repr, q.tolist())) for q in joints]
        (tmp_path / "p.csv").write_text("\n".join([HEADER.format(u="rad"), *rows]))
        return imported(tmp_path / "p.csv", UR5, **options)

    plan = plan_of_rows(HOME, through, HOME)
    assert len(plan) == 3 and plan.metrics["colliding_legs"] == 2
    lines = colliding_legs(plan)
    assert len(lines) == 2
    assert "view 0 -> view 1" in lines[0] and "inside table" in lines[0]
    # An obstacle in free air is found too.
    air = plan.chain.forward(HOME)[:3, 3]
    lamp = Box(lower=tuple(air - 0.05), upper=tuple(air + 0.05))
    for boxes, count in (((), 0), ((("lamp", lamp),), 2)):
        plan = plan_of_rows(HOME, HOME + 0.01, obstacles=boxes)
        assert plan.metrics["colliding_legs"] == count


@pytest.mark.skipif(not REAL.is_dir(), reason="REALSIM_DATA has no motion/koch_ur5_paths")
@pytest.mark.parametrize("path", sorted(REAL.glob("*.json")), ids=lambda p: p.stem)
def test_the_papers_own_paths_are_a_ur5_in_degrees(path: Path) -> None:
    found = read_path(path, None)
    assert found.reading is not None
    assert found.reading.chain is UR5 and found.reading.joint_unit == "deg"
    assert found.reading.base == "base" and found.reading.gap_m < 0.003
    # Two of the files are in millimetres and of a tool 200 mm long.
    long_tool = np.linalg.norm(found.reading.T_ee_tcp[:3, 3]) > 0.1
    assert long_tool == (found.reading.length_unit == "mm")
    refused("of another robot", read_path, path, UR5E)
    plan = imported(path, center=[-0.1, -0.67, 0.1])
    assert len(plan) + np.sum(found.via) == len(found.joints)
    assert plan.kind == "imported" and np.all(UR5.limits.contains(plan.joints))
    assert len(colliding_legs(plan)) == plan.metrics["colliding_legs"]


def said_of(data: Any, folder: Path) -> str:
    """Return how a plan file of this content is refused."""
    (folder / "p.json").write_text(json.dumps(data))
    return refused(r"p\.json", load_plan, folder / "p.json", error=RealsimError)


def said_when(change: Callable[[dict[str, Any]], object], folder: Path) -> str:
    """Return how a plan is refused that another program changed, with a hash that fits."""
    data = json.loads(json.dumps(plan_to_json(a_plan())))
    change(data)
    return said_of(data | {"sha256": hash_of(data["content"])}, folder)


@pytest.mark.parametrize("chain", [UR5E, replace(UR5, delta_d=[0, 11.2, -92.5, 81.3, 0, 0])])
def test_what_is_saved_comes_back_bit_for_bit(chain: DhChain, tmp_path: Path) -> None:
    plan = a_plan(chain)
    save_plan(plan, tmp_path / "plan.json")
    back = load_plan(tmp_path / "plan.json")
    assert back.content_hash == plan.content_hash
    for name in ("home", "joints", "center_world", "Ts_base_ee", "Ts_base_cam"):
        assert np.array_equal(getattr(back, name), getattr(plan, name)), name
    assert back.config == plan.config and back.metrics == plan.metrics
    assert asdict(back.cell) == asdict(plan.cell)
    assert [k for k, _ in back.vias] == [0, 4]
    assert all(np.array_equal(a, b) for (_, a), (_, b) in zip(back.vias, plan.vias, strict=True))
    # Saving again writes the same bytes.
    save_plan(back, tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == (tmp_path / "plan.json").read_bytes()


def test_the_hash_is_of_what_the_plan_is_made_of(tmp_path: Path) -> None:
    plan = a_plan()
    for other in (
        replace(plan, home=plan.home + 1e-12),
        replace(plan, vias=plan.vias[:1]),
        replace(plan, config=replace(plan.config, speed=1.0)),
        a_plan(UR5E),
        a_plan(seed=1),
    ):
        assert other.content_hash != plan.content_hash
    assert a_plan().content_hash == plan.content_hash


def test_another_program_drives_the_plan_from_the_segments_alone(tmp_path: Path) -> None:
    plan = a_plan()
    save_plan(plan, tmp_path / "plan.json")
    segments = json.loads((tmp_path / "plan.json").read_text())["segments"]
    at = plan.home
    for k, segment in enumerate(segments):
        corners = np.array(segment["corners"])
        assert segment["view"] == k and np.array_equal(corners[0], at)
        assert np.array_equal(corners, plan.move(k))
        assert segment["settle_s"] == 0.4
        leading = np.abs(np.diff(corners, axis=0)).max(-1)
        pace = segment["speed_rad_s"], segment["acceleration_rad_s2"]
        assert segment["seconds"] == pytest.approx(move_seconds(leading, *pace).sum(), abs=1e-6)
        at = corners[-1]
    assert np.array_equal(at, plan.joints[-1])


def test_a_plan_of_another_robot_is_named(tmp_path: Path) -> None:
    other = plan_to_json(a_plan(UR5E))["content"]
    text = said_when(lambda d: d.update(content=other), tmp_path)
    assert "fit a UR5" in text and "UR5e" in text
    assert "those of a UR5" in said_when(lambda d: d["content"].update(robot="UR5e"), tmp_path)


def test_joints_of_another_arm_are_named(tmp_path: Path) -> None:
    text = said_when(lambda d: d["content"]["joints"][2].append(0.0), tmp_path)
    assert "view 2 has 7 joint angles" in text and "a UR5, has 6 joints" in text


def test_degrees_and_millimetres_are_named(tmp_path: Path) -> None:
    def degrees(data: dict[str, Any]) -> None:
        data["content"]["joints"] = np.degrees(data["content"]["joints"]).tolist()

    text = said_when(degrees, tmp_path)
    assert "degrees" in text and "view" in text

    def small_degrees(data: dict[str, Any]) -> None:
        # poses as the radians give them, joints so near zero that no number is suspicious
        q = np.array(data["content"]["joints"])
        data |= plan_to_json(replace(a_plan(), joints=q * 0.02, home=HOME * 0.02, vias=()))
        degrees(data)

    assert "degrees; radians are needed" in said_when(small_degrees, tmp_path)

    def millimetres(data: dict[str, Any]) -> None:
        for T in data["expected"]["Ts_base_ee"]:
            for row in T[:3]:
                row[3] *= 1000.0

    assert "in millimetres; metres" in said_when(millimetres, tmp_path)
    text = said_when(lambda d: d["content"].update(center_world=[370.0, 20.0, 50.0]), tmp_path)
    assert "center_world" in text and "millimetres" in text

    def turned(data: dict[str, Any]) -> None:
        Ts = np.array(data["expected"]["Ts_base_ee"])
        data["expected"]["Ts_base_ee"] = (np.diag([-1.0, -1, 1, 1]) @ Ts).tolist()

    assert "base_link" in said_when(turned, tmp_path)


def test_one_changed_view_is_the_one_that_is_named(tmp_path: Path) -> None:
    def move(data: dict[str, Any]) -> None:
        data["expected"]["Ts_base_ee"][5][0][3] += 0.004

    assert "view 5 differs most, by 4.00 mm" in said_when(move, tmp_path)

    def bend(data: dict[str, Any]) -> None:
        data["segments"][6]["corners"][0][1] += 1e-4

    def hurry(data: dict[str, Any]) -> None:
        data["segments"][6]["speed_rad_s"] = 3.0

    for change in (bend, hurry):
        assert "segment of view 6" in said_when(change, tmp_path)


def test_no_file_ends_in_a_traceback(tmp_path: Path) -> None:
    for text in ("", "[]", '{"schema": "realsim capture plan"}', "[" * 100_000, "\x00"):
        (tmp_path / "p.json").write_text(text)
        refused(r"p\.json", load_plan, tmp_path / "p.json")


def test_every_key_is_needed_and_none_ends_in_a_traceback(tmp_path: Path) -> None:
    whole = plan_to_json(a_plan())
    content = whole["content"]
    for key in content:
        said_of(whole | {"content": {k: v for k, v in content.items() if k != key}}, tmp_path)
        said_of(whole | {"content": content | {key: "text"}}, tmp_path)
    for key in ("expected", "segments", "content", "sha256"):
        said_of({k: v for k, v in whole.items() if k != key}, tmp_path)


def test_a_plan_of_version_1_says_what_to_do(tmp_path: Path) -> None:
    text = said_of(plan_to_json(a_plan()) | {"schema_version": 1}, tmp_path)
    assert "schema version 1" in text and "Make the plan anew" in text


def test_a_shipped_plan_that_is_not_there_is_named(tmp_path: Path) -> None:
    refused("nowhere", plan_json.resolve_plan, "shipped:nowhere")
    refused("no plan at", plan_json.resolve_plan, tmp_path / "p.json")
    save_plan(a_plan(), tmp_path / "p.json")
    assert plan_json.resolve_plan(str(tmp_path / "p.json")).content_hash == a_plan().content_hash


def test_the_shipped_plan_keeps_its_promises() -> None:
    name = "ur5_d405_hemisphere_256"
    if name not in plan_json.shipped_plans():
        pytest.skip(f"{name} is not shipped")
    plan = plan_json.resolve_plan(f"shipped:{name}")
    assert len(plan) == 256 and plan.robot == "UR5" and plan.mount.camera == "D405"
    assert np.all(plan.chain.limits.contains(plan.joints))
    assert colliding_legs(plan) == ()
