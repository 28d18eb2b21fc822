"""Animations and contact sheets, where OpenGL works without a display."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from PIL import Image

from simreal import video

MODEL = mujoco.MjModel.from_xml_string("""
<mujoco>
  <worldbody>
    <light pos="0 0 4"/>
    <geom type="plane" size="9 9 .1" rgba=".3 .4 .5 1"/>
    <body name="ball" pos="0 0 .5"><freejoint/><geom size=".3" rgba="1 1 0 1"/></body>
    <body name="anchor" pos="0 -20 .5"><geom size=".3" mass="1000" rgba="0 0 0 1"/></body>
  </worldbody>
</mujoco>
""")
SIZE = (160, 120)


@pytest.fixture(scope="module")
def rolling() -> np.ndarray:
    """(6, nq): the ball moves 5 m along x."""
    qpos = np.tile(MODEL.qpos0, (6, 1))
    qpos[:, 0] = np.arange(6.0)
    try:
        with video._renderer(MODEL, SIZE):
            return qpos
    except video.RenderingUnavailable as reason:
        pytest.skip(str(reason))


def still_camera(distance: float) -> mujoco.MjvCamera:
    camera = mujoco.MjvCamera()
    camera.distance, camera.azimuth, camera.elevation = distance, 90.0, -20.0
    return camera


def yellow(picture: Image.Image) -> np.ndarray:
    """Rows and columns of the ball's pixels, (n, 2)."""
    red, _, blue = np.moveaxis(np.asarray(picture.convert("RGB"), int), -1, 0)
    return np.argwhere(red - blue > 60)


@pytest.mark.parametrize("suffix", [".gif", ".webp", ".png"])
def test_animation_has_every_frame(rolling: np.ndarray, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"clip{suffix}"
    assert video.render(MODEL, rolling, path, fps=25.0, camera=still_camera(14.0), size=SIZE) == path
    with Image.open(path) as clip:
        assert clip.n_frames == len(rolling)
        assert clip.size == SIZE
        clip.seek(1)
        clip.load()
        assert clip.info["duration"] == pytest.approx(40.0)
        early = yellow(clip)[:, 1].mean()
        clip.seek(5)
        late = yellow(clip)[:, 1].mean()
    assert late > early + 20


def test_mp4_becomes_webp_without_its_package(
    rolling: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(video, "_can_write_mp4", lambda: False)
    assert video.render(MODEL, rolling, tmp_path / "clip.mp4", 25.0, size=SIZE) == tmp_path / "clip.webp"


def test_tracking_camera_keeps_the_body_in_the_middle(rolling: np.ndarray, tmp_path: Path) -> None:
    def columns(camera: video.Camera) -> list[float]:
        path = video.render(MODEL, rolling, tmp_path / "clip.png", 25.0, camera=camera, size=SIZE)
        middles = []
        with Image.open(path) as clip:
            for frame in range(clip.n_frames):
                clip.seek(frame)
                found = yellow(clip)
                middles.append(found[:, 1].mean() if len(found) else np.nan)
        return middles

    followed = columns(video.tracking_camera(MODEL, "ball", distance=4.0, azimuth=90.0))
    np.testing.assert_allclose(followed, SIZE[0] / 2, atol=5.0)
    assert np.isnan(columns(still_camera(4.0))[-1])  # rolled out of sight


def test_geoms_are_drawn(rolling: np.ndarray, tmp_path: Path) -> None:
    def spheres(scene: mujoco.MjvScene, frame: int) -> None:
        frames.append(frame)
        video.add_sphere(scene, (-1.0, 0.0), 0.3, rgba=(1.0, 1.0, 0.0, 1.0))

    frames: list[int] = []
    pictures = []
    for name, geoms in (("plain", None), ("marked", spheres)):
        path = tmp_path / f"{name}.png"
        video.contact_sheet(MODEL, rolling, path, 1, camera=still_camera(4.0), size=SIZE, geoms=geoms)
        pictures.append(len(yellow(Image.open(path))))
    assert frames == [0]
    assert pictures[1] > pictures[0] + 50


def test_contact_sheet_and_large_pictures(rolling: np.ndarray, tmp_path: Path) -> None:
    size = (MODEL.vis.global_.offwidth + 10, 120)
    path = video.contact_sheet(MODEL, rolling, tmp_path / "sheet.png", frames=5, columns=3, size=size)
    assert Image.open(path).size == (3 * size[0], 2 * 120)
    assert MODEL.vis.global_.offwidth == size[0] - 10  # the caller's model is as it was


@pytest.mark.parametrize("qpos", [np.zeros(7), np.zeros((3, 6)), np.zeros((0, 7))])
def test_wrong_shape_is_refused(qpos: np.ndarray, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"qpos must have shape \(frames, 7\)"):
        video.render(MODEL, qpos, tmp_path / "clip.gif", 25.0)


def test_unknown_suffix_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"valid suffixes are \.gif, \.webp"):
        video.render(MODEL, np.zeros((1, 7)), tmp_path / "clip.avi", 25.0)


def test_no_opengl_is_one_plain_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(video, "_works", lambda backend: False)
    monkeypatch.setattr(video.platform, "system", lambda: "Linux")
    monkeypatch.setattr(video, "_select_backend", video._select_backend.__wrapped__)
    with pytest.raises(video.RenderingUnavailable, match="no pictures") as error:
        video.render(MODEL, np.tile(MODEL.qpos0, (2, 1)), tmp_path / "clip.gif", 25.0)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "clip.gif").exists()
