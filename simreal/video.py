"""Pictures of a trajectory without a display: animations and contact sheets through MuJoCo's renderer."""

from __future__ import annotations

import copy
import functools
import importlib
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from PIL.Image import Image

Camera: TypeAlias = str | int | mujoco.MjvCamera | None
Geoms: TypeAlias = Callable[[mujoco.MjvScene, int], None]
"""Adds decoration to the scene of frame i, for example with `add_sphere`."""

ANIMATED = (".gif", ".webp", ".png", ".apng", ".mp4")
_PROBE = """
import mujoco
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
with mujoco.Renderer(model, 8, 8) as renderer:
    renderer.update_scene(mujoco.MjData(model))
    renderer.render()
"""


class RenderingUnavailable(Exception):
    """No OpenGL works here; the message is one plain line, fit to print before going on without pictures."""


def render(
    model: mujoco.MjModel,
    qpos: ArrayLike,
    path: Path,
    fps: float,
    camera: Camera = None,
    size: tuple[int, int] = (480, 360),
    geoms: Geoms | None = None,
) -> Path:
    """Write an animation of `qpos` (frames, nq), shown at `fps` frames per second; returns its path.

    The suffix chooses the format: .webp (smallest), .gif (coarse colours, times in 10 ms), .png or .apng
    (lossless), .mp4, which needs the package imageio-ffmpeg and becomes .webp without it. Raises
    RenderingUnavailable without OpenGL, ValueError for an unknown suffix or a wrong shape.
    """
    path = Path(path)
    if path.suffix.lower() not in ANIMATED:
        raise ValueError(f"cannot write '{path.name}': valid suffixes are {', '.join(ANIMATED)}")
    if path.suffix.lower() == ".mp4" and not _can_write_mp4():
        path = path.with_suffix(".webp")
    frames = _images(model, qpos, camera, size, geoms)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix.lower() == ".mp4":
        _write_mp4(path, frames, fps, size)
    else:
        _write_animation(path, frames, fps)
    return path


def contact_sheet(
    model: mujoco.MjModel,
    qpos: ArrayLike,
    path: Path,
    frames: int = 8,
    columns: int = 4,
    camera: Camera = None,
    size: tuple[int, int] = (320, 240),
    geoms: Geoms | None = None,
    labels: Sequence[str] | None = None,
) -> Path:
    """Write one PNG with `frames` pictures at even distances in `qpos` (n, nq), read from left to right.

    `labels`, one per row of `qpos`, are written into the corners; without them the row's number is.
    `geoms` is given that number too. Raises as `render` does.
    """
    from PIL import Image, ImageDraw

    trajectory = _trajectory(model, qpos)
    chosen = np.unique(np.linspace(0, len(trajectory) - 1, min(frames, len(trajectory))).round().astype(int))
    decorate = None if geoms is None else lambda scene, i: geoms(scene, int(chosen[i]))
    width, height = size
    columns = min(columns, len(chosen))
    sheet = Image.new("RGB", (columns * width, -(-len(chosen) // columns) * height), "white")
    pen = ImageDraw.Draw(sheet)
    for place, picture in enumerate(_images(model, trajectory[chosen], camera, size, decorate)):
        corner = (place % columns * width, place // columns * height)
        sheet.paste(picture, corner)
        label = str(chosen[place]) if labels is None else labels[chosen[place]]
        place_of_label = (corner[0] + 8, corner[1] + 6)
        pen.text(place_of_label, label, "white", font_size=14, stroke_width=2, stroke_fill="black")
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    sheet.save(path)
    return path


def tracking_camera(
    model: mujoco.MjModel,
    body: str | int,
    distance: float | None = None,
    azimuth: float = 120.0,
    elevation: float = -20.0,
) -> mujoco.MjvCamera:
    """A camera that follows the body's subtree; distance in m, angles in degrees."""
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_TRACKING
    camera.trackbodyid = model.body(body).id
    camera.distance = 1.5 * model.stat.extent if distance is None else distance
    camera.azimuth, camera.elevation = azimuth, elevation
    return camera


def add_sphere(
    scene: mujoco.MjvScene, position: ArrayLike, radius: float, rgba: Sequence[float] = (0.9, 0.2, 0.1, 0.8)
) -> None:
    """Add a sphere that belongs to no body, such as a target; for use in a `geoms` callback."""
    if scene.ngeom >= scene.maxgeom:
        return
    centre = np.zeros(3)
    given = np.asarray(position, float).ravel()
    centre[: given.size] = given
    mujoco.mjv_initGeom(
        scene.geoms[scene.ngeom],
        mujoco.mjtGeom.mjGEOM_SPHERE,
        np.array([radius, 0.0, 0.0]),
        centre,
        np.eye(3).ravel(),
        np.asarray(rgba, np.float32),
    )
    scene.ngeom += 1


def _images(
    model: mujoco.MjModel, qpos: ArrayLike, camera: Camera, size: tuple[int, int], geoms: Geoms | None
) -> Iterator[Image]:
    from PIL import Image

    trajectory = _trajectory(model, qpos)
    with _renderer(model, size) as renderer:
        data = mujoco.MjData(renderer.model)
        for frame, position in enumerate(trajectory):
            data.qpos[:] = position
            mujoco.mj_forward(renderer.model, data)
            renderer.update_scene(data, camera=-1 if camera is None else camera)
            if geoms is not None:
                geoms(renderer.scene, frame)
            # Mirrors and shadows draw every mesh again: minutes instead of seconds where a CPU draws.
            for flag in (mujoco.mjtRndFlag.mjRND_REFLECTION, mujoco.mjtRndFlag.mjRND_SHADOW):
                renderer.scene.flags[flag] = False
            yield Image.fromarray(renderer.render())


def _trajectory(model: mujoco.MjModel, qpos: ArrayLike) -> NDArray[np.float64]:
    trajectory = np.asarray(qpos, np.float64)
    if trajectory.ndim != 2 or trajectory.shape[1] != model.nq or not len(trajectory):
        raise ValueError(f"qpos must have shape (frames, {model.nq}), got {trajectory.shape}")
    return np.where(np.isfinite(trajectory), trajectory, model.qpos0)


@contextmanager
def _renderer(model: mujoco.MjModel, size: tuple[int, int]) -> Iterator[Any]:
    width, height = size
    if width > model.vis.global_.offwidth or height > model.vis.global_.offheight:
        model = copy.copy(model)
        model.vis.global_.offwidth = max(width, model.vis.global_.offwidth)
        model.vis.global_.offheight = max(height, model.vis.global_.offheight)
    _select_backend()
    with mujoco.Renderer(model, height, width) as renderer:
        yield renderer


@functools.cache
def _select_backend() -> None:
    """Give MuJoCo an OpenGL context class that works without a display.

    MuJoCo decides at import, when nobody knows yet whether a picture will be wanted; so the class is put in
    place afterwards. A driver that does not work can end the process, and PyOpenGL cannot change platform
    once loaded: each candidate is tried in a process of its own first. A MUJOCO_GL set by the user is the
    only candidate then.
    """
    if platform.system() != "Linux":
        return
    chosen = os.environ.get("MUJOCO_GL", "").lower().strip()
    candidates = [chosen] if chosen else ["egl", "osmesa", *(["glfw"] if os.environ.get("DISPLAY") else [])]
    for backend in candidates:
        if not _works(backend):
            continue
        if backend in ("egl", "osmesa"):
            from mujoco.rendering.classic import gl_context

            gl_context.GLContext = importlib.import_module(f"mujoco.{backend}").GLContext
        return
    raise RenderingUnavailable(
        f"no pictures: OpenGL without a display does not work here (tried {', '.join(candidates)}); "
        "on Debian, 'apt-get install libegl1' or 'libosmesa6' provides it"
    )


def _works(backend: str) -> bool:
    environment = {name: value for name, value in os.environ.items() if name != "PYOPENGL_PLATFORM"}
    try:
        probe = subprocess.run(
            [sys.executable, "-c", _PROBE],
            env=environment | {"MUJOCO_GL": backend},
            capture_output=True,
            timeout=60.0,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return probe.returncode == 0


def _write_animation(path: Path, frames: Iterator[Image], fps: float) -> None:
    pictures = list(frames)
    options: dict[str, Any] = {"loop": 0, "duration": 1000.0 / fps}
    suffix = path.suffix.lower()
    if suffix == ".gif":
        pictures = _with_one_palette(pictures)
        options |= {"duration": max(20, 10 * round(100.0 / fps)), "optimize": False, "disposal": 1}
    elif suffix == ".webp":
        options |= {"duration": round(1000.0 / fps), "quality": 70, "method": 3}
    file_format = {".gif": "GIF", ".webp": "WEBP"}.get(suffix, "PNG")
    pictures[0].save(path, file_format, save_all=True, append_images=pictures[1:], **options)


def _with_one_palette(pictures: list[Image]) -> list[Image]:
    """All pictures in one set of 256 colours, taken from a few of them: a palette per frame flickers."""
    from PIL import Image

    samples = pictures[:: max(1, len(pictures) // 6)][:6]
    strip = Image.new("RGB", (samples[0].width, samples[0].height * len(samples)))
    for place, sample in enumerate(samples):
        strip.paste(sample, (0, place * sample.height))
    palette = strip.quantize(256, method=Image.Quantize.MEDIANCUT)
    return [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]


def _can_write_mp4() -> bool:
    try:
        importlib.import_module("imageio_ffmpeg")
    except ImportError:
        return False
    return True


def _write_mp4(path: Path, frames: Iterator[Image], fps: float, size: tuple[int, int]) -> None:
    writer = importlib.import_module("imageio_ffmpeg").write_frames(
        str(path), size, fps=fps, macro_block_size=2, ffmpeg_log_level="error"
    )
    writer.send(None)
    for frame in frames:
        writer.send(frame.tobytes())
    writer.close()
