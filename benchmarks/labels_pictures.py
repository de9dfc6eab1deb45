"""What a picture costs: the embedded renderer and the photoreal one, on the benchmark's scene.

Imported by `labels.py`. Every object and the table have a procedural material, the light is a
panorama with a sun. CPU seconds of the whole process, so that threads count; the first view, in
which things are compiled and built, does not.
"""

import time
from dataclasses import replace

import numpy as np
from figures import Found
from labels_scene import camera_720p, cameras, scene

from realsim.rendering.appearance import Environment
from realsim.rendering.photo import PhotoRenderer
from realsim.rendering.procedural.choose import object_material, table_material
from realsim.rendering.procedural.skies import sunny_sky
from realsim.rendering.rays import BACKGROUND, PlacedMesh, RayScene


def dressed(seed: int) -> tuple[list[PlacedMesh], Environment]:
    """Return the scene with materials, and the light on it."""
    rng = np.random.default_rng(seed)
    placed = [
        replace(
            p, material=table_material(rng) if p.instance == BACKGROUND else object_material(rng)
        )
        for p in scene()
    ]
    return placed, sunny_sky(rng, elevation_deg=45.0, turbidity=3.0, cover=0.2)


def picture_cost(seed: int, quick: bool) -> Found:
    """Return the CPU seconds of a frame at 1280x720 of both renderers."""
    found = Found()
    placed, environment = dressed(seed)
    camera = camera_720p(distorted=True)
    views = cameras(2 if quick else 9, 0.5, 0.7)
    begin = time.process_time()
    embedded = PhotoRenderer(placed, environment=environment)
    rng = np.random.default_rng(0)
    embedded.render(camera, views[0], rng)
    setup = time.process_time() - begin
    seconds: list[float] = []
    casts: list[float] = []
    rival = RayScene(placed)
    for T in views[1:]:
        start = time.process_time()
        embedded.render(camera, T, rng)
        seconds.append(time.process_time() - start)
        casts.append(_cast_s(rival, camera, T))
    found.figures["rgb_cpu_s"] = float(np.mean(seconds))
    found.over["rgb_cpu_s"] = (
        f"{len(seconds)} views, {min(seconds):.2f} to {max(seconds):.2f}; set-up and first view "
        f"{setup:.1f} s"
    )
    found.rivals["rgb_cpu_s"] = f"one cast of every pixel {np.mean(casts[1:] or casts):.2f} s"
    _photoreal(found, placed, environment, camera, views[: 2 if quick else 4], 4 if quick else 1)
    return found


def _cast_s(rival: RayScene, camera, T) -> float:
    from labels_cost import _cast, _rays

    from realsim.geometry.camera import ray_table

    rays = _rays(rival, ray_table(camera), T)
    start = time.process_time()
    _cast(rival, rays)
    return time.process_time() - start


def _photoreal(found: Found, placed, environment, camera, views, shrink: int) -> None:
    from realsim.errors import InputError
    from realsim.rendering.photoreal import PhotorealConfig, PhotorealRenderer

    try:
        start = time.process_time()
        renderer = PhotorealRenderer(placed, environment, PhotorealConfig())
    except InputError as error:
        found.notes.append(f"photo_cpu_s not run: {error}")
        return
    if renderer.variant.startswith("scalar"):
        shrink = 4  # minutes a frame are not measured: a sixteenth of the pixels is
    camera = replace(
        camera, width=camera.width // shrink, height=camera.height // shrink,
        fx=camera.fx / shrink, fy=camera.fy / shrink, cx=camera.cx / shrink, cy=camera.cy / shrink,
    )  # fmt: skip
    renderer.render(camera, views[0], np.random.default_rng(0))
    setup = time.process_time() - start
    seconds: list[float] = []
    for T in views[1:]:
        start = time.process_time()
        renderer.render(camera, T, np.random.default_rng(0))
        seconds.append((time.process_time() - start) * shrink**2)
    found.figures["photo_cpu_s"] = float(np.mean(seconds))
    found.over["photo_cpu_s"] = (
        f"{renderer.variant}, 8 samples a pixel and denoising, {len(seconds)} views; set-up and "
        f"first view {setup:.1f} s"
        + (f"; {shrink**2} x a picture of {camera.width}x{camera.height}" if shrink > 1 else "")
    )
    found.notes += list(renderer.notes)
