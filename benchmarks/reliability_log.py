"""Results one by one in a file: a run that is stopped keeps them, and later runs add to them.

A line is one damaged file, one batch of frames or words, or one kill, with the seed it was made by.
What is there already is not measured again; with another seed all of it is new, and adds up.
"""

import contextlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

OFFENCES = ("traceback", "memory", "crash", "nan", "hang")


class Log:
    """The lines of a file, or of this run alone; of several with one key the last one counts."""

    def __init__(self, path: Path | None) -> None:
        """Read what is there; a line that was cut off by a kill does not count."""
        self._path, self._kept = path, dict[tuple[Any, ...], dict[str, Any]]()
        for text in path.read_text().splitlines() if path is not None and path.exists() else ():
            with contextlib.suppress(ValueError):
                self._keep(json.loads(text))

    def _keep(self, line: dict[str, Any]) -> None:
        self._kept[line["part"], *line["key"]] = line

    def add(self, part: str, *key: str | int, **result: Any) -> None:
        """Write a line."""
        self._keep(line := {"part": part, "key": key, **result})
        if self._path is not None:
            with self._path.open("a") as file:
                file.write("\n" + json.dumps(line))

    def of(self, part: str) -> list[dict[str, Any]]:
        """Return the lines of a part."""
        return [line for (name, *_), line in self._kept.items() if name == part]

    def todo(self, part: str, seed: int, count: int) -> Iterable[int]:
        """Yield which of `count` numbers of a seed have no line yet."""
        return (k for k in range(count) if (part, seed, k) not in self._kept)
