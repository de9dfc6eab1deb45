"""What the packages promise: every exported name exists, and importing realsim stays light."""

import importlib
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from documents import documented

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("realsim", "realsim_calibration", "realsim_capture_plans", "realsim_sim_bridge")


@pytest.mark.parametrize("name", PACKAGES)
def test_every_promised_name_exists(name: str) -> None:
    module = importlib.import_module(name)
    missing = [n for n in getattr(module, "__all__", []) if not hasattr(module, n)]
    assert missing == []


def test_importing_realsim_loads_numpy_and_nothing_heavier() -> None:
    code = (
        "import sys, realsim\n"
        "print([m for m in ('open3d','cv2','scipy','numba','gtsam','pybullet','trimesh','viser')"
        " if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "[]", done.stdout + done.stderr


def test_running_installs_no_tests_and_tests_install_every_extra() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert project["tool"]["uv"]["default-groups"] == []
    extras = ",".join(project["project"]["optional-dependencies"])
    assert f"realsim[{extras}]" in project["dependency-groups"]["test"]


def test_ci_types_the_command_that_the_readme_gives_for_the_tests() -> None:
    command = documented("README.md", "pytest")
    assert f"\n{command} -q\n" in (ROOT / ".ci/run").read_text()


# --- the container ------------------------------------------------------------------------------


def dockerfile() -> list[str]:
    """Return the instructions of the Dockerfile, one a line."""
    text = re.sub(r"\\\n", " ", (ROOT / "Dockerfile").read_text())
    return [line for line in text.splitlines() if line and not line.startswith("#")]


def test_the_dockerfile_has_nothing_to_complain_about() -> None:
    hadolint = shutil.which("hadolint", path=Path(sys.executable).parent)
    assert hadolint is not None, "the group test installs it"
    done = subprocess.run(
        [hadolint, "--no-color", str(ROOT / "Dockerfile")], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_container_runs_as_nobody_in_particular() -> None:
    user = [line.split()[1] for line in dockerfile() if line.startswith("USER ")]
    assert user and all(int(part) >= 1000 for part in user[-1].split(":"))
    assert dockerfile()[-2:] == ['ENTRYPOINT ["realsim"]', 'CMD ["demo"]']


def test_the_image_gets_all_that_the_wheel_is_made_of_and_no_more() -> None:
    kept = {
        line[1:].strip("/")
        for line in (ROOT / ".dockerignore").read_text().splitlines()
        if line.startswith("!")
    }
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    packages = project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
    needed = {"pyproject.toml", project["project"]["readme"], *project["project"]["license-files"]}
    assert kept == needed | {p.split("/")[0] for p in packages}
    copied = [w for line in dockerfile() if line.startswith("COPY ") for w in line.split()[1:-1]]
    assert {w for w in copied if not w.startswith("--")} - {"/opt/realsim"} == kept
