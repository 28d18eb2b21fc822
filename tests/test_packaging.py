"""The wheel carries everything, and the folders at the top are importable under one name only."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


def run(*command: str | Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run a program outside the repository; its output is kept."""
    return subprocess.run(
        [str(part) for part in command], cwd=cwd, capture_output=True, text=True, timeout=300, check=False
    )


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of an environment that has the wheel, and sees this one's dependencies but not simreal."""
    folder = tmp_path_factory.mktemp("wheel")
    built = run(
        *(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"),
        *("--no-index", "--wheel-dir", folder, ROOT),
        cwd=folder,
    )
    assert built.returncode == 0, built.stderr
    (wheel,) = folder.glob("simreal-*.whl")

    site = folder / "site"
    run(sys.executable, "-m", "venv", "--without-pip", folder / "venv", cwd=folder)
    python = folder / "venv" / "bin" / "python"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    purelib = Path(
        run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=folder).stdout.strip()
    )
    ours = run(sys.executable, "-c", "import numpy; print(numpy.__path__[0])", cwd=folder).stdout.strip()
    # A .pth line adds a folder but runs no .pth file in it: an editable simreal stays out of sight.
    (purelib / "test.pth").write_text(f"{site}\n{Path(ours).parent}\n")
    return python


@pytest.mark.slow
def test_the_wheel_imports_outside_the_repository(installed: Path, tmp_path: Path) -> None:
    script = """
import pathlib, sys
import simreal.envs, simreal.randomizers, simreal.config_files as config
here = pathlib.Path(config.__file__).resolve()
assert here.is_relative_to(pathlib.Path(sys.argv[1])), here
assert pathlib.Path(simreal.envs.__file__).resolve().parent == here.parent / "envs"
print(sorted(config.shipped_configs()), config.load_config("arm_reach").environment)
"""
    done = run(installed, "-c", script, installed.parents[2], cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "'arm_reach', 'cartpole_swingup', 'go2_walk'" in done.stdout
    assert done.stdout.strip().endswith("arm_reach")


@pytest.mark.slow
def test_every_tracked_data_file_is_in_the_wheel(installed: Path) -> None:
    site = installed.parents[2] / "site" / "simreal"
    for folder in ("envs", "randomizers", "configs", "simreal"):
        for path in (ROOT / folder).rglob("*"):
            if path.suffix in {".xml", ".yaml", ".html", ".typed", ".py"}:
                inside = path.relative_to(ROOT / "simreal" if folder == "simreal" else ROOT)
                assert (site / inside).is_file(), f"{inside} is not in the wheel"


@pytest.mark.parametrize("folder", ["envs", "randomizers"])
def test_the_bare_name_is_refused(folder: str) -> None:
    done = run(sys.executable, "-c", f"import {folder}", cwd=ROOT)
    assert done.returncode == 1
    assert f"ImportError: the folder '{folder}' of simreal" in done.stderr
    assert f"'import simreal.{folder}'" in done.stderr
