"""The process that compiles an MJCF file: `python -m realsim.formats.robot_scenes.mjcf_worker`.

    python -m ... SCENE.xml FOLDER      writes FOLDER/found.json and FOLDER/shapes.npz, or error.txt

MuJoCo's compiler alone knows its defaults, includes and frames. It is C and can be crashed by a
file, or made to take all memory: here it is alone, and the system limits what it takes.
"""

import json
import resource
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import UInt8

MOST_MEMORY = 4_000_000_000
"""Address space of the process [bytes]: MuJoCo itself maps 1 GB, mostly of nothing."""
MOST_CPU_S = 30
"""[s]: a scene of a hundred scanned objects compiles in ten."""
FOUND, SHAPES, FAILED = "found.json", "shapes.npz", "error.txt"


def compile_scene(path: Path, folder: Path) -> None:
    """Compile a file and write what it holds."""
    import mujoco

    module: Any = mujoco
    model: Any = module.MjModel.from_xml_path(str(path))
    shapes: dict[str, NDArray[Any]] = {}
    for k in range(model.nmesh):
        shapes |= _mesh(model, k)
    for k in range(model.ntex):
        picture = _texture(model, k)
        if picture is not None:
            shapes[f"texture_{k}"] = picture
    found = {
        "name": str(model.names[: model.names.find(b"\0")].decode("utf-8", errors="replace")),
        "gravity": model.opt.gravity.tolist(),
        "bodies": [_body(module, model, k) for k in range(model.nbody)],
        "geoms": [_geom(module, model, k) for k in range(model.ngeom)],
    }
    np.savez(folder / SHAPES, **shapes)  # pyright: ignore[reportArgumentType]
    (folder / FOUND).write_text(json.dumps(found), encoding="utf-8")


def _body(module: Any, model: Any, k: int) -> dict[str, Any]:
    first, count = int(model.body_jntadr[k]), int(model.body_jntnum[k])
    free = int(module.mjtJoint.mjJNT_FREE)
    kinds = [int(model.jnt_type[j]) for j in range(first, first + count)]
    return {
        "name": model.body(k).name,
        "parent": int(model.body_parentid[k]),
        "joints": "none" if not kinds else "free" if kinds == [free] else "other",
        "pos": model.body_pos[k].tolist(),
        "quat": model.body_quat[k].tolist(),
        "mass": float(model.body_mass[k]),
        "ipos": model.body_ipos[k].tolist(),
        "iquat": model.body_iquat[k].tolist(),
        "inertia": model.body_inertia[k].tolist(),
    }


def _geom(module: Any, model: Any, k: int) -> dict[str, Any]:
    kind = module.mjtGeom(int(model.geom_type[k])).name.removeprefix("mjGEOM_").lower()
    material, texture = int(model.geom_matid[k]), -1
    if material >= 0:
        texture = int(model.mat_texid[material][int(module.mjtTextureRole.mjTEXROLE_RGB)])
    return {
        "name": model.geom(k).name,
        "body": int(model.geom_bodyid[k]),
        "type": kind,
        "size": model.geom_size[k].tolist(),
        "pos": model.geom_pos[k].tolist(),
        "quat": model.geom_quat[k].tolist(),
        "mesh": int(model.geom_dataid[k]) if kind == "mesh" else -1,
        "collides": bool(model.geom_contype[k] or model.geom_conaffinity[k]),
        "friction": float(model.geom_friction[k, 0]),
        "texture": texture,
        "rgba": (model.geom_rgba[k] if material < 0 else model.mat_rgba[material]).tolist(),
    }


def _mesh(model: Any, k: int) -> dict[str, NDArray[Any]]:
    v, nv = int(model.mesh_vertadr[k]), int(model.mesh_vertnum[k])
    f, nf = int(model.mesh_faceadr[k]), int(model.mesh_facenum[k])
    shapes: dict[str, NDArray[Any]] = {
        f"vertices_{k}": np.array(model.mesh_vert[v : v + nv], dtype=np.float64),
        f"faces_{k}": np.array(model.mesh_face[f : f + nf], dtype=np.int32),
    }
    t, nt = int(model.mesh_texcoordadr[k]), int(model.mesh_texcoordnum[k])
    if t >= 0 and nt > 0:
        uv = np.array(model.mesh_texcoord[t : t + nt], dtype=np.float64)
        shapes[f"corner_uv_{k}"] = uv[model.mesh_facetexcoord[f : f + nf]]
    return shapes


def _texture(model: Any, k: int) -> UInt8 | None:
    """Return a picture (H, W, 3), None if it is another kind of texture."""
    start, channels = int(model.tex_adr[k]), int(model.tex_nchannel[k])
    height, width = int(model.tex_height[k]), int(model.tex_width[k])
    if channels not in (3, 4):
        return None
    data: Any = model.tex_data[start : start + height * width * channels]
    picture: UInt8 = np.array(data, dtype=np.uint8).reshape(height, width, channels)
    return picture[..., :3].copy()


def main() -> None:
    """Run for the arguments."""
    path, folder = Path(sys.argv[1]), Path(sys.argv[2])
    resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY, MOST_MEMORY))
    resource.setrlimit(resource.RLIMIT_CPU, (MOST_CPU_S, MOST_CPU_S))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        compile_scene(path, folder)
    except ImportError as error:
        (folder / FAILED).write_text(f"import: {error}", encoding="utf-8")
    except Exception as error:  # whatever the compiler says of a file
        (folder / FAILED).write_text(f"file: {error}", encoding="utf-8")


if __name__ == "__main__":
    main()
