"""Pages whose commands and snippets are run in order, and whose printed lines are looked for."""

import os
import re
import signal
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

from printed import missing_lines

from documents import Block, blocks

SERVER = "# Ctrl-C ends it"
START_S = 60.0
ENVIRONMENT = {
    **os.environ, "COLUMNS": "120", "NO_COLOR": "1", "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1", "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
}  # fmt: skip
ENVIRONMENT.pop("REALSIM_CONFIG", None)


def read(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def run(words: list[str], folder: Path) -> str:
    """Run to the end and return what was printed; it must end with 0."""
    done = subprocess.run(
        words, cwd=folder, env=ENVIRONMENT, capture_output=True, text=True, timeout=3600
    )
    assert done.returncode == 0, f"{words} ended with {done.returncode}:\n{done.stderr[-3000:]}"
    return done.stdout


def serve(line: str, folder: Path) -> str:
    """Run a server until its page can be had, end it as Ctrl-C does, return what it printed."""
    log = folder / "server.txt"
    with log.open("w") as out:
        server = subprocess.Popen(
            ["bash", "-c", f"exec {line} --port 0"], cwd=folder, env=ENVIRONMENT,
            stdout=out, stderr=subprocess.STDOUT,
        )  # fmt: skip
        try:
            until, found = time.monotonic() + START_S, None
            while found is None and time.monotonic() < until and server.poll() is None:
                time.sleep(0.2)
                found = re.search(r"http://\S+", read(log))
            assert found is not None, read(log)
            with urllib.request.urlopen(found[0], timeout=START_S) as page:
                assert page.status == 200 and b"<html" in page.read().lower()
            server.send_signal(signal.SIGINT)
            assert server.wait(START_S) in (0, 130), read(log)
        finally:
            server.kill()
    return read(log)


def printed_by(block: Block, folder: Path) -> str:
    """Run a block of the tour and return what it printed."""
    if block.kind == "python":
        return run([sys.executable, "-c", block.text], folder)
    out: list[str] = []
    for line in block.text.splitlines():
        if SERVER in line:
            out.append(serve(line.partition("#")[0].strip(), folder))
        elif line.strip():
            out.append(run(["bash", "-c", line], folder))
    return "\n".join(out)


def play(page: Path, folder: Path) -> list[str]:
    """Run the blocks of a page in order and return what was not printed."""
    wrong, printed = list[str](), ""
    for block in blocks(read(page)):
        if block.kind in ("sh", "python"):
            printed = printed_by(block, folder)
        elif block.kind == "toml":
            file = folder / block.text.splitlines()[0].removeprefix("# ")
            file.parent.mkdir()
            file.write_text(block.text, encoding="utf-8")
        elif block.kind == "text":
            wrong += [
                f"{page.name}: not printed: {line}\n{printed[-2500:]}"
                for line in missing_lines(block.text, printed)
            ]
    return wrong
