"""How exact labels are: against projection, against renders of one object, against rasterisers.

Imported by `labels.py`.
"""

import ctypes.util

import numpy as np
from figures import Found
from labels_scene import LENS, camera_720p, cameras, scene

from realsim.geometry import camera, se3
from realsim.records import CameraIntrinsics
from realsim.rendering.labels import LabelRenderer
from realsim.rendering.rays import RayScene, rotated

LENSES = {
    "brown5 (a D405's)": LENS,
    "barrel": [-0.30, 0.12, 0.0, 0.0, 0.0],
    "pincushion": [0.25, 0.10, 0.001, -0.002, 0.0],
    "rational8": [0.9, 0.3, 5e-4, -3e-4, 0.02, 1.2, 0.5, 0.03],
    "folding back": [-0.30, 0.02, 0.0, 0.0, 0.0],
}


def exactness(seed: int, quick: bool) -> Found:
    """Return how far hits reproject, and by how many pixels masks differ from references."""
    found = Found()
    _reprojection(found, quick)
    _masks(found, quick)
    return found


def _reprojection(found: Found, quick: bool) -> None:
    import cv2

    renderer = LabelRenderer(scene())
    worst, said = 0.0, []
    for name, lens in LENSES.items():
        f = 520.0 if name == "folding back" else 650.0
        i = CameraIntrinsics.from_K(
            np.array([[f, 0, 638.2], [0, f, 361.4], [0, 0, 1]]), 1280, 720, np.array(lens)
        )
        unknown = 0.0
        largest = 0.0
        for T in cameras(1 if quick else 8, 0.5, 0.7):
            labels = renderer.render(i, T)
            v, u = np.nonzero(labels.geometry >= 0)
            points = camera.ray_table(i)[v, u].astype(np.float64) * labels.depth_m[v, u, None]
            uv = cv2.projectPoints(points, np.zeros(3), np.zeros(3), i.K, i.distortion)[0][:, 0]
            largest = max(largest, float(np.abs(uv - np.stack([u, v], -1)).max()))
            unknown = float(labels.unknown.mean())
            assert not np.any(labels.depth_m[labels.unknown])
        worst = max(worst, largest)
        said.append(f"{name} {largest:.1e} px, {100 * unknown:.1f} % of the pixels without a ray")
    found.figures["reproj_px_worst"] = worst
    found.over["reproj_px_worst"] = "; ".join(said)


def _masks(found: Found, quick: bool) -> None:
    placed = scene()
    renderer = LabelRenderer(placed)
    i = camera_720p()
    views = cameras(1 if quick else 32, 0.5, 0.7)
    amodal = different = alone_different = seen = 0
    gl_different = gl_seen = 0
    gl = _gl_caster(placed, i)
    objects = placed[1:6] if quick else placed[1:]
    alone = {p.instance: (LabelRenderer([p]), RayScene([p])) for p in objects}
    whole = RayScene(placed)
    for T in views:
        labels = renderer.render(i, T)
        rays = rotated(camera.ray_table(i), T[:3, :3]).reshape(-1, 3)
        _, geometry = whole.first_hits(T[:3, 3], rays)
        different += int(np.count_nonzero(geometry.reshape(labels.ids.shape) != labels.geometry))
        seen += int(np.count_nonzero(labels.ids >= 0))
        if gl is not None:
            gl_different += int(np.count_nonzero(gl(T) != labels.geometry))
            gl_seen += int(np.count_nonzero(labels.ids >= 0))
        for p in objects:
            ours, embree = alone[p.instance]
            mask = labels.amodal[p.instance]
            amodal += int(np.count_nonzero(ours.render(i, T).visible(p.instance) != mask))
            hit = embree.occluded(T[:3, 3], rays).reshape(mask.shape)
            alone_different += int(np.count_nonzero(hit != mask))
    found.figures["amodal_px_diff"] = float(amodal)
    shares = {"Embree": different / seen}
    if gl is not None:
        shares["OpenGL"] = gl_different / gl_seen
    found.figures["visible_px_diff_share"] = max(shares.values())
    found.over["visible_px_diff_share"] = (
        ", ".join(f"{k} {v:.1e}" for k, v in shares.items())
        + f" of {seen} object pixels in {len(views)} views"
        + ("" if gl is not None else "; OpenGL did not run: no EGL")
    )
    found.over["amodal_px_diff"] = (
        f"Embree alone on each object differs in {alone_different} pixels of "
        f"{len(views) * len(objects)} masks"
    )


def _gl_caster(placed, i: CameraIntrinsics):
    """Return a function from camera to the ids that OpenGL rasterises; None where it cannot run."""
    if ctypes.util.find_library("EGL") is None:
        return None
    try:
        import moderngl

        context = moderngl.create_standalone_context(backend="egl")
    except Exception:
        return None
    program = context.program(
        vertex_shader="#version 330\nuniform mat4 M; in vec3 p; "
        "void main(){gl_Position=M*vec4(p,1);}",
        fragment_shader="#version 330\nuniform int id; out int c; void main(){c=id;}",
    )
    ids = context.texture((i.width, i.height), 1, dtype="i4")
    depth = context.depth_renderbuffer((i.width, i.height))
    frame = context.framebuffer([ids], depth)
    arrays = [
        context.vertex_array(
            program,
            [(context.buffer(p.mesh.vertices[p.mesh.faces].astype("f4").tobytes()), "3f", "p")],
        )
        for p in placed
    ]
    near, far = 0.05, 5.0
    # Pixel centres are integers in K and halves in OpenGL; row 0 is the image's first.
    P = np.array([
        [2 * i.fx / i.width, 0, 2 * (i.cx + 0.5) / i.width - 1, 0],
        [0, 2 * i.fy / i.height, 2 * (i.cy + 0.5) / i.height - 1, 0],
        [0, 0, (far + near) / (far - near), -2 * far * near / (far - near)],
        [0, 0, 1, 0],
    ])  # fmt: skip

    def cast(T):
        frame.use()
        context.enable(moderngl.DEPTH_TEST)
        frame.clear(-1, -1, -1, -1)
        T_cam_world = se3.invert(T)
        for k, (p, array) in enumerate(zip(placed, arrays, strict=True)):
            M = P @ T_cam_world @ p.T_world_obj
            program["M"].write(M.T.astype("f4").tobytes())
            program["id"].value = k
            array.render()
        seen = np.frombuffer(ids.read(), np.int32).reshape(i.height, i.width)
        return np.where(seen < 0, -1, seen)  # the clear colour is written as a float's bits

    return cast
