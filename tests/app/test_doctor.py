"""`realsim doctor`: what it finds is so, a crash is a finding, and it names the way out."""

import json
import subprocess
import sys
import tomllib
from collections.abc import Mapping
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from realsim.app.console import Console
from realsim.app.doctor import machine, run
from realsim.app.doctor.machine import Finding, Outcome, isolated
from realsim.app.doctor.run import EXTRAS, REQUIRED, show
from realsim_capture_plans.devices.ur_loopback import LoopbackController
from typed_commands import realsim

PROJECT = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
OK = Outcome(ok=True, told="")


def outcomes(**changed: Outcome) -> Mapping[str, Outcome]:
    found = dict.fromkeys([*run.software_probes(), "import:pyrealsense2"], OK)
    return found | {name.replace("__", ":").replace("_so", ".so"): o for name, o in changed.items()}


def named(findings: list[Finding], name: str) -> Finding:
    return next(f for f in findings if f.name == name)


# --- the packages are those of the project ------------------------------------------------------


def test_every_package_of_the_project_is_looked_at_and_no_other() -> None:
    wanted = {Requirement(line).name for line in PROJECT["dependencies"]}
    assert {p.name for p in REQUIRED} == wanted
    optional = PROJECT["optional-dependencies"].items()
    extras = {(extra, Requirement(line).name) for extra, lines in optional for line in lines}
    assert {(p.extra, p.name) for p in EXTRAS} == extras


def test_a_missing_extra_is_a_note_with_the_command_that_gets_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    extra = EXTRAS[0].extra
    monkeypatch.setattr(run, "_version", lambda p: None if p.extra == extra else "1.0")
    found = run.software_findings(outcomes())
    missing = [f for f in found if f.kind != "ok" and f.group.startswith("Extras")]
    assert {f.name for f in missing} == {p.name for p in EXTRAS if p.extra == extra}
    assert all(f.kind == "note" and f"realsim[{extra}]" in f.todo for f in missing)


def test_a_package_that_cannot_be_loaded_says_why() -> None:
    bad = Outcome(ok=False, told="crashed (SIGSEGV)")
    found = named(run.software_findings(outcomes(import__open3d=bad)), "open3d-cpu")
    assert found.kind == "problem" and "SIGSEGV" in found.found


def test_a_missing_library_is_a_problem_with_its_debian_package() -> None:
    missing = Outcome(ok=False, told="no such file")
    told = {**outcomes(), "library:libusb-1.0.so.0": missing, "import:pyrealsense2": missing}
    found = named(run.software_findings(told), "libusb-1.0.so.0")
    assert found.kind == "problem"
    assert "apt-get install" in found.todo and "libusb-1.0-0" in found.todo


# --- isolation ----------------------------------------------------------------------------------

CRASHING = """
import os, signal, sys, time
from realsim.app.doctor import probe
def crash(what):
    if what == "slow": time.sleep(60)
    if what == "exit": os._exit(3)
    os.kill(os.getpid(), getattr(signal, what))
probe.PROBES["crash"] = crash
probe.PROBES["loud"] = lambda what: os.write(1, b'{"probe": "loud:x"}') and "done"
probe.main(sys.argv[1:])
"""


@pytest.fixture
def crashing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the probes' program have probes that crash, in real processes."""
    real = subprocess.Popen

    def popen(command: list[str], **options: object) -> object:
        assert command[1:3] == ["-m", "realsim.app.doctor.probe"]
        return real([sys.executable, "-c", CRASHING, *command[3:]], **options)  # type: ignore[call-overload]

    monkeypatch.setattr(machine.subprocess, "Popen", popen)


@pytest.mark.usefixtures("crashing")
def test_a_crash_takes_only_its_own_probe_along() -> None:
    names = ["import:json", "crash:SIGSEGV", "crash:exit", "import:no_such_module_here",
             "loud:x", "import:math"]  # fmt: skip
    ticks: list[tuple[int, int]] = []
    found = isolated(names, lambda done, total: ticks.append((done, total)))
    assert list(found) and set(found) == set(names)
    assert {n for n, o in found.items() if o.ok} == {"import:json", "loud:x", "import:math"}
    assert found["crash:SIGSEGV"].told == "crashed (SIGSEGV)"
    assert "exit code 3" in found["crash:exit"].told
    assert "No module named 'no_such_module_here'" in found["import:no_such_module_here"].told
    assert found["loud:x"].told == "done"  # what libraries print is no answer
    assert ticks[-1][1] == len(names)


@pytest.mark.usefixtures("crashing")
def test_what_hangs_is_ended() -> None:
    found = isolated(["crash:slow", "import:json"], lambda done, total: None, timeout_s=3.0)
    assert not found["crash:slow"].ok and "3 s" in found["crash:slow"].told
    assert found["import:json"].ok


# --- the machine --------------------------------------------------------------------------------


def test_what_the_store_needs_works_here_and_nothing_is_left(tmp_path: Path) -> None:
    good, bad = (
        named(machine.machine_findings(folder, OK), "locks and atomic writing")
        for folder in (tmp_path, Path("/proc"))
    )
    assert good.kind == "ok" and list(tmp_path.iterdir()) == []
    assert bad.kind == "problem" and "/proc" in bad.found and "local disk" in bad.todo


# --- devices ------------------------------------------------------------------------------------


def test_a_robot_that_answers_is_found_and_a_silent_one_within_the_time() -> None:
    with LoopbackController.start(robot="UR5", speedup=10) as controller:
        found = run.robot_findings(controller.host)
        assert [f.kind for f in found] == ["ok", "ok"], found
    found = run.robot_findings("192.0.2.1", timeout_s=0.3)  # TEST-NET: nobody answers there
    assert [f.kind for f in found] == ["problem", "problem"]
    assert all("network" in f.todo for f in found)


@pytest.mark.parametrize("host", ["a" * 70, "\udcff"])
def test_a_text_that_can_be_no_name_is_one_problem_that_can_be_printed(host: str) -> None:
    (found,) = run.robot_findings(host)
    assert found.kind == "problem" and "no host name" in found.found
    found.found.encode("utf-8")


# --- the command --------------------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "fine"), [("ok", True), ("note", True), ("problem", False)])
def test_only_a_problem_fails(kind: str, fine: bool, capsys: pytest.CaptureFixture[str]) -> None:
    finding = Finding(group="Machine", name="clock", kind=kind, found="x", todo="set it")  # type: ignore[arg-type]
    assert show([finding], Console()) is fine
    assert "set it" in capsys.readouterr().out


@pytest.mark.slow
def test_the_whole_examination_is_right_about_this_machine(tmp_path: Path) -> None:
    done = realsim("doctor", tmp_path, "--json")
    told = json.loads(done.stdout)
    kinds = {f["name"]: f["kind"] for f in told["findings"]}
    assert done.returncode == (0 if told["ok"] else 1)
    assert all(kinds[p.name] == "ok" for p in REQUIRED)  # these tests run with all of them
    assert list(tmp_path.iterdir()) == []
